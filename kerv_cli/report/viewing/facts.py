"""An episode's totals and its decodes as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kerv_cli.engine.record import DecodeRecord, EpisodeRecord
from kerv_cli.report.viewing.token_outcomes import OUTCOMES, TokenOutcome, acceptance

_SHOWN_SYMBOLS = set("→✓×≈·–…≤≥±αφσ") | {style.symbol for style in OUTCOMES.values()}


def readable(text: str) -> str:
    """Return text on one line, with `?` for characters that the viewer's font lacks: they crash the 0.41 viewer."""
    return "".join(c if " " <= c <= "~" or "\xa1" <= c <= "ÿ" or c in _SHOWN_SYMBOLS else "?" for c in text)


def facts_of(record: EpisodeRecord, method: str) -> dict[str, str | float]:
    """Return the episode's totals, which are stored as properties of the recording."""
    rounds = [r for d in record.decodes for r in d.rounds if r.is_verification]
    facts: dict[str, str | float] = {
        "environment": readable(record.environment),
        "task": readable(record.task),
        "instruction": readable(record.instruction),
        "method": readable(method),
        "seed": record.seed,
        "success": record.success,
        "steps": record.steps,
        "decodes": len(record.decodes),
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
    facts, modes = facts_of(record, method), [d.mode for d in record.decodes]
    rows = {
        "instruction": facts["instruction"],
        "method, seed": f"{facts['method']}, {record.seed}",
        "control steps": f"{record.steps} ({record.steps / record.space.control_hz:.2f} s)",
        "decodes": ", ".join(f"{modes.count(m)} {readable(m)}" for m in dict.fromkeys(modes)),
        "forwards per step": f"{facts['forwards_per_step']:.2f}",
        "inference per step": f"{facts['ms_per_step']:.2f} ms",
        "compensated tokens": facts["compensated_tokens"],
        "decodes without verification": facts["skipped_decodes"],
    }
    if "acceptance_length" in facts:
        rows["tokens per verification (AL)"] = f"{facts['acceptance_length']:.2f}"
    key = {f"{style.symbol} {name}": style.meaning for name, style in OUTCOMES.items()}
    head = (str(facts["task"]), "SUCCESS" if record.success else "FAILURE")
    return "\n".join([*_table(head, rows), "", *_table(("token", "outcome"), key)])


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
    lines = [
        f"**Decode {number} at step {step}: {decode.mode}**  ",
        _decode_line(decode),
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


def _decode_line(decode: DecodeRecord) -> str:
    """Return forwards, verifications, acceptance, compensation and time of a decode in one line."""
    parts = [f"{decode.forwards} forward{'s' * (decode.forwards != 1)}"]
    if decode.verifications:
        length, accepted = acceptance(decode.rounds)
        parts.append(
            f"{decode.verifications} verified · per verification {length:.2f} committed, {accepted:.2f} accepted"
        )
    if decode.compensated:
        parts.append(f"{decode.compensated} compensated")
    if decode.skipped:
        parts.append("verification skipped")
    if decode.reason is not None:
        parts.append(decode.reason)
    parts.append(f"{len(decode.actions)} step{'s' * (len(decode.actions) != 1)} · {1000 * decode.seconds:.1f} ms")
    return " · ".join(parts)
