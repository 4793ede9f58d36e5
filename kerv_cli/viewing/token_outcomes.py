"""What became of every token of a decode, from its record: colours, symbols and the table that a person reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kerv_cli.decoding.record import DecodeRecord, Round


@dataclass(frozen=True)
class FateStyle:
    """How a fate is drawn. Colours tell apart for colour-blind eyes too (Okabe-Ito); the symbol says it again."""

    symbol: str
    color: int  # 0xRRGGBBAA
    meaning: str


FATES: dict[str, FateStyle] = {
    "accepted": FateStyle("✓", 0x009E73FF, "draft equal to the target's verdict"),
    "relaxed": FateStyle("≈", 0x7BCB8FFF, "draft off the verdict by 1 to r bins, and kept"),
    "rejected": FateStyle("×", 0xD1321FFF, "draft refused: here the path ended"),
    "bonus": FateStyle("+", 0x56B4E9FF, "the target's verdict after a wholly accepted draft"),
    "target": FateStyle("·", 0x6E7B8BFF, "decoded by the target without a draft"),
    "compensated": FateStyle("~", 0xE69F00FF, "filled by a prediction instead of the target"),
    "skipped": FateStyle("»", 0xF0E442FF, "executed without a verification"),
    "dropped": FateStyle("–", 0x2E3238FF, "not executed: the rest of the chunk was dropped"),
}
_DOF_NAMES = {4: ("dx", "dy", "dz", "gripper"), 7: ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")}


@dataclass(frozen=True)
class TokenFate:
    """One place of a chunk. None where there was none: no draft, no verdict, no limit, no token known."""

    fate: str  # a key of FATES
    token: int | None = None  # what was committed
    draft: int | None = None
    verdict: int | None = None
    limit: int | None = None  # r of this token's DoF, in bins
    round: int | None = None  # which round of the decode decided

    @property
    def short(self) -> str:
        """`draft → verdict` where they differ, else the one token that there is; at most 9 characters."""
        if self.draft is not None and self.verdict is not None and self.draft != self.verdict:
            return f"{self.draft} → {self.verdict}"
        known = next((x for x in (self.draft, self.verdict, self.token) if x is not None), None)
        return FATES[self.fate].symbol if known is None else str(known)


def dof_names(dofs: int) -> tuple[str, ...]:
    """Names of the D degrees of freedom of one control step (METHODS §0)."""
    return _DOF_NAMES.get(dofs, tuple(f"dof {i}" for i in range(dofs)))


def chunk_size(decodes: Sequence[DecodeRecord], dofs: int) -> int:
    """N, the tokens of a chunk; at least what any decode judged, committed or executed, in whole control steps."""
    most = 1
    for decode in decodes:
        judged = [r.start + max(len(r.drafted), len(r.target_tokens)) for r in decode.rounds]
        most = max(most, decode.size, len(decode.tokens), len(decode.actions) * dofs, *judged)
    return -(-most // dofs) * dofs


def fates_of(decode: DecodeRecord, size: int, dofs: int) -> list[TokenFate]:
    """The fate of each of the `size` tokens of a decode's chunk, in chunk order.

    A rejected place stays rejected, whoever filled it later; any other place that was not executed is dropped.
    """
    fates: list[TokenFate | None] = [None] * size
    for number, played in enumerate(decode.rounds):
        for place, fate in _fates_of_round(played, number):
            before = fates[place]
            if before is None or before.fate != "rejected":
                fates[place] = fate
    executed = len(decode.actions) * dofs
    for place in range(max(0, executed - decode.compensated), executed):  # the prediction fills up the last steps
        before = fates[place]
        if before is None or before.fate != "rejected":
            fates[place] = TokenFate("compensated")
    return [_settled(fate, decode, place, place < executed) for place, fate in enumerate(fates)]


def _fates_of_round(played: Round, number: int) -> list[tuple[int, TokenFate]]:
    """(index in the chunk, fate) of what one round judged."""
    found = []
    for i in range(max(len(played.drafted), len(played.target_tokens))):
        draft = played.drafted[i] if i < len(played.drafted) else None
        verdict = played.target_tokens[i] if i < len(played.target_tokens) else None
        place = played.start + i
        if played.mode == "skip":
            fate = "skipped"
        elif draft is None:
            fate = "bonus" if played.drafted else "target"
        elif i >= played.accepted:
            fate = "rejected"
        else:
            fate = "accepted" if draft == verdict else "relaxed"
        limit = played.threshold[place % len(played.threshold)] if played.threshold and draft is not None else None
        found.append((place, TokenFate(fate, None, draft, verdict, limit, number)))
    return found


def _settled(fate: TokenFate | None, decode: DecodeRecord, place: int, executed: bool) -> TokenFate:
    """The fate with its committed token, once it is known which control steps were executed."""
    token = decode.tokens[place] if place < len(decode.tokens) else None
    if fate is None:
        fate = TokenFate("skipped" if decode.skipped or not decode.forwards else "target")
    name = fate.fate if executed or fate.fate == "rejected" else "dropped"
    return TokenFate(name, token, fate.draft, fate.verdict, fate.limit, fate.round)


def decode_table(decode: DecodeRecord, number: int, step: int, fates: Sequence[TokenFate], dofs: int) -> str:
    """A decode as Markdown: one line about it and a row per token."""
    names = dof_names(dofs)
    lines = [
        f"**Decode {number} at step {step}: {decode.mode}**  ",
        decode_line(decode),
        "",
        "| token | step | DoF | round | draft | verdict | off by | r | kept | fate |",
        "|--:|--:|:--|--:|--:|--:|--:|--:|--:|:--|",
    ]
    for place, fate in enumerate(fates):
        both = fate.draft is not None and fate.verdict is not None
        off = abs((fate.draft or 0) - (fate.verdict or 0)) if both else None
        numbers = [_cell(x) for x in (fate.round, fate.draft, fate.verdict, off, fate.limit, fate.token)]
        word = f"{FATES[fate.fate].symbol} {fate.fate}"
        word = f"**{word}**" if fate.fate == "rejected" else word
        lines.append(f"| {place} | {place // dofs} | {names[place % dofs]} | {' | '.join(numbers)} | {word} |")
    return "\n".join(lines)


def decode_line(decode: DecodeRecord) -> str:
    """Forwards, verifications, acceptance, compensation and time of a decode, in one line."""
    parts = [f"{decode.forwards} forward{'s' * (decode.forwards != 1)}"]
    if decode.verifications:
        length, accepted = acceptance(decode)
        parts.append(f"{decode.verifications} verified · AL {length:.2f} · accepted {accepted:.2f}")
    if decode.compensated:
        parts.append(f"{decode.compensated} compensated")
    if decode.skipped:
        parts.append("verification skipped")
    parts.append(f"{len(decode.actions)} step{'s' * (len(decode.actions) != 1)} · {1000 * decode.seconds:.1f} ms")
    return " · ".join(parts)


def acceptance(decode: DecodeRecord) -> tuple[float, float]:
    """AL (tokens committed per verification) and accepted per round (METHODS §7) of a decode that verified."""
    rounds = [r for r in decode.rounds if r.tree_size > 0 and r.mode != "skip"]
    return sum(r.committed for r in rounds) / len(rounds), sum(r.accepted for r in rounds) / len(rounds)


def _cell(value: int | None) -> str:
    return "" if value is None else str(value)
