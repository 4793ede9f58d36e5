"""An episode's totals: as properties of a recording, and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping

from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.report.viewing.token_outcomes import OUTCOMES, acceptance

_SHOWN_SYMBOLS = set("→✓×≈·–…≤≥±αφσ") | {s.symbol for s in OUTCOMES.values()}


def readable(text: str) -> str:
    """`text` on one line, with `?` for characters that the viewer's font lacks: they crash the 0.41 viewer."""
    return "".join(c if " " <= c <= "~" or "\xa1" <= c <= "ÿ" or c in _SHOWN_SYMBOLS else "?" for c in text)


def facts_of(record: EpisodeRecord, method: str) -> dict[str, str | float]:
    """The episode's totals, stored as properties of the recording."""
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
    """The episode as Markdown, with the key to the tokens' colours."""
    facts = facts_of(record, method)
    modes = [d.mode for d in record.decodes]
    rows = {
        "instruction": str(facts["instruction"]),
        "method, seed": f"{facts['method']}, {record.seed}",
        "control steps": f"{record.steps} ({record.steps / record.space.control_hz:.2f} s)",
        "decodes": ", ".join(f"{modes.count(m)} {readable(m)}" for m in dict.fromkeys(modes)),
        "forwards per step": f"{facts['forwards_per_step']:.2f}",
    }
    if "acceptance_length" in facts:
        rows["AL"] = f"{facts['acceptance_length']:.2f}"
        rows["accepted per round"] = f"{facts['accepted_per_round']:.2f}"
    rows["compensated tokens"] = str(facts["compensated_tokens"])
    rows["decodes without verification"] = str(facts["skipped_decodes"])
    rows["inference per step"] = f"{facts['ms_per_step']:.2f} ms"
    key = {f"{style.symbol} {name}": style.meaning for name, style in OUTCOMES.items()}
    outcome = "SUCCESS" if record.success else "FAILURE"
    lines = [f"| {facts['task']} | {outcome} |", "|:--|:--|", *_table_rows(rows)]
    return "\n".join([*lines, "", "| token | outcome |", "|:--|:--|", *_table_rows(key)])


def _table_rows(rows: Mapping[str, object]) -> list[str]:
    return [f"| {name} | {value} |" for name, value in rows.items()]
