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
