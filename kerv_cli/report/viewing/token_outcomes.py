"""Find out what happened to each token of a decode (accepted, rejected, …), from the decode's record."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from kerv_cli.engine.record import DecodeRecord, EpisodeRecord
from kerv_cli.episodes.identity import hash_of


class OutcomeStyle(NamedTuple):
    """How the viewer shows an outcome. The colours (0xRRGGBBAA) are Okabe and Ito's, for colour-blind readers."""

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
    "ended": OutcomeStyle(" ", 0x1B1E22FF, "no token: this chunk of a code has fewer"),
}


@dataclass(frozen=True)
class TokenOutcome:
    """What happened to one token of a chunk: a key of OUTCOMES, and the tokens at its position, if there were any."""

    kind: str
    token: int | None = None
    draft: int | None = None
    target: int | None = None
    limit: int | None = None  # acceptance threshold r of the token's DoF, in bins


def threshold_of(decode: DecodeRecord) -> tuple[int, ...]:
    """Return the acceptance threshold r of each DoF in a decode, in bins. Empty if no round stored a threshold."""
    return next(filter(None, map(attrgetter("threshold"), decode.rounds)), ())


def token_names(decodes: Sequence[DecodeRecord], dofs: Sequence[str]) -> Sequence[str]:
    """Return the names of a control step's tokens: `dofs`, or the single name `token` for FAST tokens.

    FAST tokens encode whole chunks, so they have no DoF (docs/methods.md §0.3). The tokens are taken for FAST tokens if
    some decode without compensation has a number of tokens that is no multiple of D.
    """
    for decode in decodes:
        if not decode.compensated and len(decode.tokens) % len(dofs):
            return ["token"]
    return dofs


def _is_coded(decode: DecodeRecord, dofs: int) -> bool:
    return decode.actions.ndim == 2 and decode.actions.shape[1] != dofs


def chunk_size(decodes: Sequence[DecodeRecord], dofs: int) -> int:
    """Return N, the number of tokens of a chunk: the most that any decode verified, committed or executed.

    It is rounded up to whole control steps of `dofs` tokens.
    """
    most = 1
    for decode in decodes:
        most = max(most, len(decode.tokens))
        if not _is_coded(decode, dofs):
            most = max(most, decode.size, len(decode.actions) * dofs)
        for one in decode.rounds:
            most = max(most, one.start + max(len(one.drafted), len(one.target_tokens)))
    return -(-most // dofs) * dofs


def outcomes_of(decode: DecodeRecord, size: int, dofs: int) -> list[TokenOutcome]:
    """Return the outcome of each of the N tokens (`size`) of a decode's chunk.

    A rejected token stays `rejected` even if a prediction replaced it later. All other tokens that were not executed
    are `dropped`. With FAST tokens, positions after the chunk's end are `ended`.
    """
    is_coded = _is_coded(decode, dofs)
    executed = len(decode.tokens) if is_coded else len(decode.actions) * dofs
    unjudged = "skipped" if decode.skipped or not decode.forwards else "target"  # of tokens that appear in no round
    is_scripted = not (decode.skipped or decode.rounds or decode.tokens)
    outcomes = [TokenOutcome("scripted" if is_scripted else unjudged)] * size
    for one_round in decode.rounds:
        drafts, threshold = one_round.drafted, one_round.threshold
        for i, (draft, target) in enumerate(itertools.zip_longest(drafts, one_round.target_tokens)):
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
            if outcomes[index].kind != "rejected":
                outcomes[index] = TokenOutcome(kind, None, draft, target, limit)
    for index in decode.filled or range(max(0, executed - decode.compensated), executed):
        if outcomes[index].kind != "rejected":
            outcomes[index] = TokenOutcome("compensated")
    for index in range(executed, size):
        if outcomes[index].kind != "rejected":
            outcomes[index] = TokenOutcome("ended") if is_coded else replace(outcomes[index], kind="dropped")
    for index, token in enumerate(decode.tokens[:size]):
        outcomes[index] = replace(outcomes[index], token=token)
    return outcomes


def acceptance(decodes: Iterable[DecodeRecord]) -> tuple[float, ...]:
    """Return the mean committed and accepted tokens per verification (docs/methods.md §7). Empty if there is none."""
    rounds = itertools.chain.from_iterable(map(attrgetter("rounds"), decodes))
    verifications = list(filter(attrgetter("is_verification"), rounds))
    counts = list(map(attrgetter("committed", "accepted"), verifications))
    return tuple(np.mean(counts, axis=0).tolist()) if counts else ()


_SHOWN_SYMBOLS = "→✓≈–…≤≥αφσ"  # and those of OUTCOMES, which are among them or in Latin-1


def readable(text: str) -> str:
    """Return the text on one line, with `?` in place of characters that the viewer's font lacks.

    Such characters crash version 0.41 of the viewer.
    """
    return re.sub(rf"[^ -~\xa1-ÿ{_SHOWN_SYMBOLS}]", "?", text)


def tokens_hash(decodes: Sequence[DecodeRecord]) -> str:
    return hash_of([list(one.tokens) for one in decodes])


def facts_of(record: EpisodeRecord, method: str) -> dict[str, str | float]:
    modes = Counter(map(attrgetter("mode"), record.decodes))
    facts: dict[str, str | float] = {
        "environment": readable(record.environment),
        "task": readable(record.task),
        "instruction": readable(record.instruction),
        "method": readable(method),
        "seed": record.seed,
        "success": record.success,
        "steps": record.steps,
        "decodes": len(record.decodes),
        "modes": ", ".join(f"{number} {readable(mode)}" for mode, number in modes.items()),
        "forwards": record.forwards,
        "forwards_per_step": record.forwards / record.steps,
        "ms_per_step": 1000 * record.seconds / record.steps,
        "inference_seconds": record.seconds,
        "wall_seconds": record.wall_seconds,
        "skipped_decodes": sum(map(attrgetter("skipped"), record.decodes)),
        "compensated_tokens": sum(map(attrgetter("compensated"), record.decodes)),
    }
    names = ("acceptance_length", "accepted_per_round")
    return facts | dict(zip(names, acceptance(record.decodes)))  # noqa: B905 - there may be none


def summary(record: EpisodeRecord, method: str) -> str:
    lines = ["| episode |  |", "|:--|:--|"]
    for name, value in facts_of(record, method).items():
        lines.append(f"| {name.replace('_', ' ')} | {f'{value:.4g}' if isinstance(value, float) else value} |")
    lines += ["", "| token | outcome |", "|:--|:--|"]
    for name, style in OUTCOMES.items():
        lines.append(f"| {style.symbol} {name} | {style.meaning} |")
    return "\n".join(lines)


def decode_table(
    decode: DecodeRecord, number: int, step: int, outcomes: Sequence[TokenOutcome], names: Sequence[str]
) -> str:
    """Return a decode as Markdown: a line of totals, then a table with one row per token.

    Args:
        number: Number of the decode in the episode, from 0.
        step: Control step at which the decode's first action is executed.
        names: Names of a control step's tokens, from `token_names`.
    """
    is_coded = _is_coded(decode, len(names))
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
        f"| token |{'' if is_coded else ' step | DoF |'} draft | target | r | kept | outcome |",
        f"|--:|{'' if is_coded else '--:|:--|'}--:|--:|--:|--:|:--|",
    ]
    for index, outcome in enumerate(outcomes):
        if outcome.kind == "ended":
            continue
        step, dof = divmod(index, len(names))
        word = f"{OUTCOMES[outcome.kind].symbol} {outcome.kind}"
        word = f"**{word}**" if outcome.kind == "rejected" else word
        place = [index] if is_coded else [index, step, names[dof]]
        cells = (*place, outcome.draft, outcome.target, outcome.limit, outcome.token, word)
        lines.append(f"| {' | '.join('' if cell is None else str(cell) for cell in cells)} |")
    return "\n".join(lines)
