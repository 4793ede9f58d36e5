"""Success at a latency that the world feels (docs/methods.md §8): every setting beside AR at the same latency."""

from __future__ import annotations

import json

import pandas as pd

from kerv_cli.episodes.identity import Plain
from kerv_cli.episodes.settings import REAL
from kerv_cli.report.measures import MICRO, measure
from kerv_cli.report.summary import Column, intervals, lost_won, numbers, shares, text_frame
from kerv_cli.report.tables import StudyData, is_autoregressive, rows_of

_MEASURES = (
    "felt_latency_ms", "felt_latency_steps", "held_share", "forwards_per_step", "successes", "success", "success_low",
    "success_high", "pairs", "difference", "difference_low", "difference_high", "only_baseline", "only_method",
    "mcnemar_p",
)  # fmt: skip


def latency_table(data: StudyData) -> pd.DataFrame | None:
    """Return one row per setting whose world goes on during a decode, pooled over tasks.

    A row has the setting's latency, its success, and the difference from AR with the same `rollout.*` in the same
    episodes. `ar_latency_ms` is the mean latency of AR's decodes there. None if every world waits, or no setting is AR.
    """
    settings = {label: setting.settings for label, setting in data.settings.items()}
    episodes = {str(label): group for label, group in data.episodes.groupby("label", sort=False)}
    real = [label for label in data.labels if settings[label]["rollout"]["clock"] == REAL]
    references = {_key(settings[label]): label for label in reversed(real) if is_autoregressive(settings[label])}
    rows = []
    for label in real:
        reference = references.get(_key(settings[label]))
        if reference is None:
            continue
        values, ar = measure(episodes[label], episodes[reference], MICRO), episodes[reference]
        rows.append(
            {
                "study": data.study.name,
                "label": label,
                "method": settings[label]["method"],
                "ar": reference,
                **{f"rollout.{name}": value for name, value in settings[label]["rollout"].items()},
                "ar_latency_ms": 1000.0 * float(ar["delay_seconds"].sum() / ar["delay_decodes"].sum()),
                "episodes": len(episodes[label]),
                **{name: values[name] for name in _MEASURES},
                **{f"{part}.kind": settings[label][part]["kind"] for part in ("prefill_draft", "proposer")},
            }
        )
    return pd.DataFrame(rows) if rows else None


def _key(settings: Plain) -> str:
    return json.dumps(settings["rollout"], sort_keys=True)


def latency_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return the main columns of `latency_table` as text."""
    columns = (
        Column("setting", lambda row: str(row["label"])),
        Column("AR takes, ms", numbers("ar_latency_ms")),
        Column("a decode takes, ms", numbers("felt_latency_ms")),
        Column("control steps meanwhile", numbers("felt_latency_steps")),
        Column("steps on a held action", shares("held_share")),
        Column("success, %", intervals("success", 100.0, 0)),
        Column("change against AR", intervals("difference", 100.0, 0, " to ", of_baseline=" ")),
        Column("lost / won", lost_won),
    )
    return text_frame(({**row, "baseline": row["ar"]} for row in rows_of(table)), columns)
