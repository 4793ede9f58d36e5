"""How far two independent runs of a study agree: the speedup of every setting in both (docs/methods.md §7)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
from rich import box
from rich.table import Table

from kerv_cli.base.errors import UsageError
from kerv_cli.report.measures import MICRO
from kerv_cli.report.summary import number
from kerv_cli.report.tables import is_number, rows_of, values_of

CLOSE = 0.03
"""Two runs agree on a ratio where it differs by at most this share."""

_MEASURES = ("successes", "pairs", "episode_speedup", "episode_speedup_low", "episode_speedup_high",
             "speedup", "speedup_low", "speedup_high", "time_per_step_ms", "gauge_ms")  # fmt: skip
_ORIGIN = ("device_name", "run", "git_commit")


def agreement_table(table: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """One row per averaging and setting that the `study_table`s of two runs share: the measures of both, those of the
    other run with the suffix `_again`; ratio: the other run's speedup over this one's; close: the ratio differs from 1
    by at most `CLOSE`; overlap: whether the two intervals overlap.

    Raises:
        UsageError: no setting in common, different baselines, or two tables of one run.
    """
    if set(table["baseline"]) != set(other["baseline"]):
        raise UsageError(f"two runs with the baselines {table['baseline'].iloc[0]} and {other['baseline'].iloc[0]}")
    if values_of(table, "run") & values_of(other, "run"):
        raise UsageError(f"both hold episodes of run {table['run'].iloc[0]}: compare with another run's results folder")
    keys = ["averaging", "label", "baseline"]
    columns = [*keys, *_MEASURES, *_ORIGIN]
    both = table[columns].merge(other[columns], on=keys, suffixes=("", "_again"))
    both = both[both["label"] != both["baseline"]].drop(columns="baseline").reset_index(drop=True)
    if both.empty:
        raise UsageError("the two runs have no setting in common")
    ratio = both["speedup_again"] / both["speedup"]
    overlap = (both["speedup_low"] <= both["speedup_high_again"]) & (both["speedup_low_again"] <= both["speedup_high"])
    both.insert(2, "ratio", ratio)
    both.insert(3, "close", (ratio - 1).abs() <= CLOSE)
    both.insert(4, "overlap", overlap)
    return both


def agreement_summary(table: pd.DataFrame, averaging: str = MICRO) -> Table:
    """The rows of one averaging, for the terminal."""
    rows = table[table["averaging"] == averaging]
    close, count = int(rows["close"].sum()), len(rows)
    caption = (
        f"{close} of {count} ratios agree within {100 * CLOSE:.0f} %, {int(rows['overlap'].sum())} intervals overlap"
    )
    printed = Table(
        title="two runs", caption=caption, title_justify="left", caption_justify="left", box=box.SIMPLE_HEAD
    )
    printed.add_column("setting")
    for name in ("speedup", "again", "difference", "success", "again"):
        printed.add_column(name, justify="right")
    for row in rows_of(rows):
        again = {name: row[f"{name}_again"] for name in _MEASURES}
        printed.add_row(
            str(row["label"]),
            _speedup(row),
            _speedup(again),
            f"{100 * (row['ratio'] - 1):+.1f} %" if is_number(row["ratio"]) else "–",
            f"{row['successes']}/{row['pairs']}",
            f"{again['successes']}/{again['pairs']}",
        )
    return printed


def _speedup(row: Mapping[str, Any]) -> str:
    if not is_number(row["speedup"]):
        return "–"
    return f"{number(row['speedup'])} ({number(row['speedup_low'])}–{number(row['speedup_high'])})"
