"""Success at a latency that the world feels (docs/methods.md §8): every setting beside AR at the same latency."""

from __future__ import annotations

import pandas as pd

from kerv_cli.report.measures import MICRO
from kerv_cli.report.tables import is_number

_COLUMNS = (
    "study", "label", "method", "ar", "rollout.clock", "rollout.latency", "rollout.latency_ms", "rollout.profile",
    "rollout.ar_ms", "rollout.delay_compensation", "rollout.batch", "ar_latency_ms", "episodes", "felt_latency_ms",
    "felt_latency_steps", "held_share", "forwards_per_step", "successes", "success", "success_low", "success_high",
    "pairs", "difference", "difference_low", "difference_high", "only_baseline", "only_method", "mcnemar_p",
    "prefill_draft.kind", "proposer.kind",
)  # fmt: skip


def latency_table(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a study's table whose world, and whose baseline's world, goes on during a decode.

    Its additional column `ar_latency_ms` is the mean latency of the baseline's decodes.
    """
    rows = table[table["averaging"] == MICRO]
    latencies = dict(zip(rows["label"], rows["felt_latency_ms"], strict=True))
    rows = rows.assign(ar=rows["baseline"], ar_latency_ms=rows["baseline"].map(latencies))
    return rows.loc[rows["felt_latency_ms"].map(is_number) & rows["ar_latency_ms"].map(is_number), list(_COLUMNS)]
