"""Success at a latency that the world feels (docs/methods.md §8): every setting beside AR at the same latency."""

from __future__ import annotations

import json

import pandas as pd

from kerv_cli.episodes.identity import Plain
from kerv_cli.episodes.settings import REAL
from kerv_cli.report.measures import MICRO, measure
from kerv_cli.report.tables import StudyData, is_autoregressive, rows_of
from kerv_cli.report.text import LOST_WON, Column, compared, intervals, lost_won, numbers, p_value, shares, text_frame

_SUCCESS = ("successes", "success", "success_low", "success_high")
_FELT = ("felt_latency_ms", "felt_latency_steps", "held_share", "forwards_per_step")
_DIFFERENCE = ("pairs", "difference", "difference_low", "difference_high", "only_baseline", "only_method", "mcnemar_p")


def latency_table(data: StudyData) -> pd.DataFrame | None:
    """One row per setting whose world goes on during a decode, pooled over tasks: its latency, its success, and the
    difference from AR with the same `rollout.*` in the same episodes. `ar_latency_ms`: mean latency of AR's decodes in
    those episodes. None where every world waits, or no setting is AR."""
    settings = {label: setting.settings for label, setting in data.settings.items()}
    episodes = {str(label): group for label, group in data.episodes.groupby("label", sort=False)}
    real = [label for label in data.labels if settings[label]["rollout"]["clock"] == REAL]
    references = {_key(settings[label]): label for label in reversed(real) if is_autoregressive(settings[label])}
    rows = []
    for label in real:
        reference = references.get(_key(settings[label]))
        if reference is None:
            continue
        values = measure(episodes[label], episodes[reference], MICRO)
        ar = episodes[reference]
        head = {"study": data.study.name, "label": label, "method": settings[label]["method"], "ar": reference}
        timing = {f"rollout.{name}": value for name, value in settings[label]["rollout"].items()}
        latency = {"ar_latency_ms": 1000.0 * float(ar["delay_seconds"].sum() / ar["delay_decodes"].sum())}
        measures = {name: values[name] for name in (*_FELT, *_SUCCESS, *_DIFFERENCE)}
        parts = {f"{part}.kind": settings[label][part]["kind"] for part in ("prefill_draft", "proposer")}
        rows.append({**head, **timing, **latency, "episodes": len(episodes[label]), **measures, **parts})
    return pd.DataFrame(rows) if rows else None


def _key(settings: Plain) -> str:
    return json.dumps(settings["rollout"], sort_keys=True)


def latency_summary(table: pd.DataFrame) -> pd.DataFrame:
    """The main columns of `latency_table` as text."""
    rows = [{**row, "baseline": row["ar"]} for row in rows_of(table)]
    return text_frame(rows, _COLUMNS)


_COLUMNS = (
    Column("setting", lambda row: str(row["label"])),
    Column("AR takes, ms", numbers("ar_latency_ms")),
    Column("it takes, ms", numbers("felt_latency_ms")),
    Column("steps", numbers("felt_latency_steps")),
    Column("held", shares("held_share")),
    Column("success %", intervals("success", 100.0, 0)),
    Column("minus AR's", compared(intervals("difference", 100.0, 0, " to "))),
    Column(LOST_WON, compared(lost_won)),
    Column("p", compared(p_value)),
)
