"""Outcomes of a decode's tokens, from its record: colours, symbols and a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from kerv_cli.engine.record import DecodeRecord, Round


@dataclass(frozen=True)
class OutcomeStyle:
    """Colour and symbol of a token outcome; the colours are Okabe-Ito's, which colour-blind readers can tell apart."""

    symbol: str
    color: int  # 0xRRGGBBAA
    meaning: str


OUTCOMES: dict[str, OutcomeStyle] = {
    "accepted": OutcomeStyle("✓", 0x009E73FF, "draft equal to the target token"),
    "relaxed": OutcomeStyle("≈", 0x7BCB8FFF, "draft off the target token by 1 to r bins, and kept"),
    "rejected": OutcomeStyle("×", 0xD1321FFF, "draft refused: the accepted path ends before it"),
    "bonus": OutcomeStyle("+", 0x56B4E9FF, "the target token behind a wholly accepted draft"),
    "target": OutcomeStyle("·", 0x6E7B8BFF, "decoded by the target without a draft"),
    "compensated": OutcomeStyle("~", 0xE69F00FF, "filled by a prediction instead of the target"),
    "skipped": OutcomeStyle("»", 0xF0E442FF, "executed without a verification"),
    "scripted": OutcomeStyle("=", 0x4E79A7FF, "an action without tokens: a scripted expert's"),
    "dropped": OutcomeStyle("–", 0x2E3238FF, "not executed: the rest of the chunk was dropped"),
}


@dataclass(frozen=True)
class TokenOutcome:
    """The outcome of one token of a chunk. A field is None where the token has no draft, no target token, no limit, no
    committed value or no round."""

    kind: str  # a key of OUTCOMES
    token: int | None = None  # what was committed
    draft: int | None = None
    target: int | None = None
    limit: int | None = None  # r of this token's DoF, in bins
    round: int | None = None  # which round of the decode decided


Chunks = Sequence[Sequence[TokenOutcome]]
"""Outcomes of the tokens of each decode's chunk."""


def threshold_of(decode: DecodeRecord) -> tuple[int, ...]:
    """r per DoF of a decode, in bins; empty without an acceptance rule that has a threshold."""
    return next((r.threshold for r in decode.rounds if r.threshold), ())


def chunk_size(decodes: Sequence[DecodeRecord], dofs: int) -> int:
    """N, the tokens of a chunk; at least what any decode judged, committed or executed, in whole control steps."""
    most = 1
    for decode in decodes:
        judged = [r.start + max(len(r.drafted), len(r.target_tokens)) for r in decode.rounds]
        most = max(most, decode.size, len(decode.tokens), len(decode.actions) * dofs, *judged)
    return -(-most // dofs) * dofs


def outcomes_of(decode: DecodeRecord, size: int, dofs: int) -> list[TokenOutcome]:
    """The outcome of each of the chunk's `size` tokens.

    A rejected token stays `rejected` even if it was filled later; other tokens that were not executed are `dropped`.
    """
    outcomes: list[TokenOutcome | None] = [None] * size
    for number, one_round in enumerate(decode.rounds):
        for index, outcome in round_outcomes(one_round, number):
            before = outcomes[index]
            if before is None or before.kind != "rejected":
                outcomes[index] = outcome
    executed = len(decode.actions) * dofs
    for index in range(max(0, executed - decode.compensated), executed):  # predictions fill the last executed tokens
        before = outcomes[index]
        if before is None or before.kind != "rejected":
            outcomes[index] = TokenOutcome("compensated")
    return [_committed_outcome(outcome, decode, index, index < executed) for index, outcome in enumerate(outcomes)]


def round_outcomes(one_round: Round, number: int) -> list[tuple[int, TokenOutcome]]:
    """(index in the chunk, outcome) of every token that one round judged."""
    outcomes = []
    drafts, targets, threshold = one_round.drafted, one_round.target_tokens, one_round.threshold
    for i in range(max(len(drafts), len(targets))):
        draft = drafts[i] if i < len(drafts) else None
        target = targets[i] if i < len(targets) else None
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
        outcomes.append((index, TokenOutcome(kind, None, draft, target, limit, number)))
    return outcomes


def _committed_outcome(outcome: TokenOutcome | None, decode: DecodeRecord, index: int, executed: bool) -> TokenOutcome:
    """The outcome with its committed token, given whether its control step was executed."""
    token = decode.tokens[index] if index < len(decode.tokens) else None
    if outcome is None:
        outcome = TokenOutcome(_unjudged(decode))
    kind = outcome.kind if executed or outcome.kind == "rejected" else "dropped"
    return replace(outcome, kind=kind, token=token)


def _unjudged(decode: DecodeRecord) -> str:
    """Outcome of a token that is in no round of the decode."""
    if not decode.skipped and not decode.rounds and not decode.tokens:
        return "scripted"
    return "skipped" if decode.skipped or not decode.forwards else "target"


def decode_table(
    decode: DecodeRecord, number: int, step: int, outcomes: Sequence[TokenOutcome], names: Sequence[str]
) -> str:
    """A decode as Markdown: a line of totals and a row per token. names: of the D DoFs."""
    lines = [
        f"**Decode {number} at step {step}: {decode.mode}**  ",
        decode_line(decode),
        "",
        "| token | step | DoF | round | draft | target | off by | r | kept | outcome |",
        "|--:|--:|:--|--:|--:|--:|--:|--:|--:|:--|",
    ]
    for index, outcome in enumerate(outcomes):
        off = None
        if outcome.draft is not None and outcome.target is not None:
            off = abs(outcome.draft - outcome.target)
        numbers = (outcome.round, outcome.draft, outcome.target, off, outcome.limit, outcome.token)
        word = f"{OUTCOMES[outcome.kind].symbol} {outcome.kind}"
        word = f"**{word}**" if outcome.kind == "rejected" else word
        row = (index, index // len(names), names[index % len(names)], *map(_cell, numbers), word)
        lines.append(f"| {' | '.join(map(str, row))} |")
    return "\n".join(lines)


def decode_line(decode: DecodeRecord) -> str:
    """Forwards, verifications, acceptance, compensation and time of a decode, in one line."""
    parts = [f"{decode.forwards} forward{'s' * (decode.forwards != 1)}"]
    if decode.verifications:
        length, accepted = acceptance(decode.rounds)
        parts.append(f"{decode.verifications} verified · AL {length:.2f} · accepted {accepted:.2f}")
    if decode.compensated:
        parts.append(f"{decode.compensated} compensated")
    if decode.skipped:
        parts.append("verification skipped")
    if decode.reason is not None:
        parts.append(decode.reason)
    parts.append(f"{len(decode.actions)} step{'s' * (len(decode.actions) != 1)} · {1000 * decode.seconds:.1f} ms")
    return " · ".join(parts)


def acceptance(rounds: Sequence[Round]) -> tuple[float, float]:
    """AL (tokens committed per verification) and accepted per round (docs/methods.md §7); rounds: at least one that
    verified."""
    rounds = [r for r in rounds if r.is_verification]
    return sum(r.committed for r in rounds) / len(rounds), sum(r.accepted for r in rounds) / len(rounds)


def _cell(value: int | None) -> str:
    return "" if value is None else str(value)
