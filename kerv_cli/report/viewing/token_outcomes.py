"""What became of each token of a decode, from its record."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from kerv_cli.engine.record import DecodeRecord, EpisodeRecord, Round


class OutcomeStyle(NamedTuple):
    """How an outcome is drawn. The colours (0xRRGGBBAA) are Okabe and Ito's, for colour-blind readers."""

    symbol: str
    color: int
    meaning: str


OUTCOMES = {
    "accepted": OutcomeStyle("✓", 0x009E73FF, "draft equal to the target token"),
    "relaxed": OutcomeStyle("≈", 0x7BCB8FFF, "draft off the target token by 1 to r bins, and kept"),
    "rejected": OutcomeStyle("×", 0xD1321FFF, "draft refused: the accepted path ends before it"),
    "bonus": OutcomeStyle("+", 0x56B4E9FF, "the target token after a wholly accepted draft"),
    "target": OutcomeStyle("·", 0x6E7B8BFF, "decoded by the target without a draft"),
    "compensated": OutcomeStyle("~", 0xE69F00FF, "filled by a prediction instead of the target"),
    "skipped": OutcomeStyle("»", 0xF0E442FF, "executed without a verification"),
    "scripted": OutcomeStyle("=", 0x4E79A7FF, "an action of a scripted expert, without tokens"),
    "dropped": OutcomeStyle("–", 0x2E3238FF, "not executed: the rest of the chunk was dropped"),
}


@dataclass(frozen=True)
class TokenOutcome:
    """The outcome of one token of a chunk; a field is None if the token has no such value.

    Attributes:
        kind: A key of OUTCOMES.
        token: What was committed.
        draft: What was drafted.
        target: What the target decoded.
        limit: r of the token's DoF, in bins.
    """

    kind: str
    token: int | None = None
    draft: int | None = None
    target: int | None = None
    limit: int | None = None


Chunks = Sequence[Sequence[TokenOutcome]]
"""Outcomes of the tokens of each decode's chunk."""


def threshold_of(decode: DecodeRecord) -> tuple[int, ...]:
    """Return r per DoF of a decode, in bins; empty if its acceptance rule has no threshold."""
    return next((r.threshold for r in decode.rounds if r.threshold), ())


def chunk_size(decodes: Sequence[DecodeRecord], dofs: int) -> int:
    """Return N, the tokens of a chunk; at least what any decode judged, committed or executed, in whole steps."""
    most = 1
    for decode in decodes:
        judged = [r.start + max(len(r.drafted), len(r.target_tokens)) for r in decode.rounds]
        most = max(most, decode.size, len(decode.tokens), len(decode.actions) * dofs, *judged)
    return -(-most // dofs) * dofs


def outcomes_of(decode: DecodeRecord, size: int, dofs: int) -> list[TokenOutcome]:
    """Return the outcome of each of the chunk's `size` tokens.

    A rejected token stays `rejected` even if it was filled later. Other tokens that were not executed are `dropped`.
    """
    executed = len(decode.actions) * dofs
    outcomes = [TokenOutcome(_unjudged(decode))] * size
    judged = [pair for one_round in decode.rounds for pair in _judged(one_round)]
    filled = range(max(0, executed - decode.compensated), executed)  # predictions fill the last executed tokens
    for index, outcome in [*judged, *((index, TokenOutcome("compensated")) for index in filled)]:
        if outcomes[index].kind != "rejected":
            outcomes[index] = outcome
    tokens = [*decode.tokens, *[None] * size]
    return [
        replace(one, kind=one.kind if index < executed or one.kind == "rejected" else "dropped", token=tokens[index])
        for index, one in enumerate(outcomes)
    ]


def _judged(one_round: Round) -> list[tuple[int, TokenOutcome]]:
    """Return (index in the chunk, outcome) of every token that one round judged."""
    outcomes = []
    drafts, targets, threshold = one_round.drafted, one_round.target_tokens, one_round.threshold
    for i, (draft, target) in enumerate(itertools.zip_longest(drafts, targets)):
        index = one_round.start + i
        if one_round.mode == "skip":
            kind = "skipped"
        elif draft is None:
            kind = "bonus" if drafts else "target"
        elif i >= one_round.accepted:
            kind = "rejected"
        else:
            kind = "accepted" if draft == target else "relaxed"
        limit = threshold[index % len(threshold)] if threshold and draft is not None else None
        outcomes.append((index, TokenOutcome(kind, None, draft, target, limit)))
    return outcomes


def _unjudged(decode: DecodeRecord) -> str:
    """Return the outcome of a token that is in no round of the decode."""
    if not decode.skipped and not decode.rounds and not decode.tokens:
        return "scripted"
    return "skipped" if decode.skipped or not decode.forwards else "target"


def acceptance(rounds: Sequence[Round]) -> tuple[float, float]:
    """Return tokens committed and drafts accepted per verification (docs/methods.md §7), of at least one."""
    rounds = [r for r in rounds if r.is_verification]
    return sum(r.committed for r in rounds) / len(rounds), sum(r.accepted for r in rounds) / len(rounds)


_SHOWN_SYMBOLS = set("→✓×≈·–…≤≥±αφσ") | {style.symbol for style in OUTCOMES.values()}


def readable(text: str) -> str:
    """Return text on one line, with `?` for characters that the viewer's font lacks: they crash the 0.41 viewer."""
    return "".join(c if " " <= c <= "~" or "\xa1" <= c <= "ÿ" or c in _SHOWN_SYMBOLS else "?" for c in text)


def facts_of(record: EpisodeRecord, method: str) -> dict[str, str | float]:
    """Return the episode's totals, which are stored as properties of the recording."""
    modes = [decode.mode for decode in record.decodes]
    rounds = [r for decode in record.decodes for r in decode.rounds if r.is_verification]
    facts: dict[str, str | float] = {
        "environment": readable(record.environment),
        "task": readable(record.task),
        "instruction": readable(record.instruction),
        "method": readable(method),
        "seed": record.seed,
        "success": record.success,
        "steps": record.steps,
        "decodes": len(modes),
        "modes": ", ".join(f"{modes.count(mode)} {readable(mode)}" for mode in dict.fromkeys(modes)),
        "forwards": record.forwards,
        "forwards_per_step": record.forwards / record.steps,
        "ms_per_step": 1000 * record.seconds / record.steps,
        "inference_seconds": record.seconds,
        "wall_seconds": record.wall_seconds,
        "skipped_decodes": sum(d.skipped for d in record.decodes),
        "compensated_tokens": sum(d.compensated for d in record.decodes),
    }
    if rounds:
        facts["acceptance_length"], facts["accepted_per_round"] = acceptance(rounds)
    return facts


def summary(record: EpisodeRecord, method: str) -> str:
    """Return the episode as Markdown, with the key to the tokens' colours."""
    facts = facts_of(record, method).items()
    rows = {name.replace("_", " "): f"{value:.4g}" if isinstance(value, float) else value for name, value in facts}
    key = {f"{style.symbol} {name}": style.meaning for name, style in OUTCOMES.items()}
    return "\n".join([*_table(("episode", ""), rows), "", *_table(("token", "outcome"), key)])


def _table(head: tuple[str, str], rows: Mapping[str, object]) -> list[str]:
    return [f"| {head[0]} | {head[1]} |", "|:--|:--|", *(f"| {name} | {value} |" for name, value in rows.items())]


def decode_table(
    decode: DecodeRecord, number: int, step: int, outcomes: Sequence[TokenOutcome], names: Sequence[str]
) -> str:
    """Return a decode as Markdown: a line of totals and a row per token.

    Args:
        decode: The decode.
        number: Its number in the episode.
        step: Control step at which its actions begin.
        outcomes: Of its tokens.
        names: Names of the D DoFs.
    """
    counts = {
        "forwards": decode.forwards,
        "verifications": decode.verifications,
        "tokens compensated": decode.compensated,
        "steps": len(decode.actions),
        "ms": f"{1000 * decode.seconds:.1f}",
        "reason": decode.reason,
    }
    lines = [
        f"**Decode {number} at step {step}: {decode.mode}**  ",
        " · ".join(f"{name}: {value}" for name, value in counts.items() if value),
        "",
        "| token | step | DoF | draft | target | r | kept | outcome |",
        "|--:|--:|:--|--:|--:|--:|--:|:--|",
    ]
    for index, outcome in enumerate(outcomes):
        step, dof = divmod(index, len(names))
        tokens = ("" if v is None else v for v in (outcome.draft, outcome.target, outcome.limit, outcome.token))
        word = f"{OUTCOMES[outcome.kind].symbol} {outcome.kind}"
        cells = (index, step, names[dof], *tokens, f"**{word}**" if outcome.kind == "rejected" else word)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)
