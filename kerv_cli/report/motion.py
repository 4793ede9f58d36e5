"""What an episode costs besides inference: control steps, way, jerk and gripper switches, each paired with the
baseline's (docs/methods.md §7)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MACRO, paired
from kerv_cli.report.statistics import Estimate

MOTION = {"steps_to_success": "steps", "path_m": "path_length", "jerk": "jerk", "gripper_switches": "gripper_switches"}
"""Measure -> column of rows.EPISODE_SCHEMA."""


def motion(episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str) -> dict[str, float]:
    """Of the successful episodes: the mean of every measure, and its ratio to the baseline's over the pairs in which
    both succeeded, with a bootstrap 95 % interval. NaN where cells are older than a measure, without such pairs, and
    where the baseline's mean is 0.

    Args:
        episodes, baseline: as in `measures.measure`.
        averaging: MACRO takes unweighted means over difficulty groups.
    """
    macro = averaging == MACRO
    won = episodes[episodes["success"].astype(bool)]
    pairs = paired(episodes, baseline)
    pairs = pairs[pairs["success_method"].astype(bool) & pairs["success_baseline"].astype(bool)]
    keys = ["task", "seed", "repeat"]
    sides = {name: pairs[keys].merge(frame[[*keys, *MOTION.values()]], on=keys, how="left")
             for name, frame in (("method", episodes), ("baseline", baseline))}  # fmt: skip
    columns: dict[str, float] = {}
    for name, column in MOTION.items():
        columns[name] = _mean(won, column, macro)
        times = [sides[side][column].to_numpy(dtype=float, na_value=np.nan) for side in ("method", "baseline")]
        ratio = _ratio(times[0], times[1], pairs, macro)
        columns |= {f"{name}_ratio": ratio.value, f"{name}_ratio_low": ratio.low, f"{name}_ratio_high": ratio.high}
    return columns


def _mean(episodes: pd.DataFrame, column: str, macro: bool) -> float:
    values = episodes[column].astype(float)
    if values.empty or values.isna().any():
        return math.nan
    return float(values.groupby(episodes["difficulty"]).mean().mean() if macro else values.mean())


def _ratio(method: np.ndarray, baseline: np.ndarray, pairs: pd.DataFrame, macro: bool) -> Estimate:
    if not len(method) or np.isnan([*method, *baseline]).any() or not baseline.sum():
        return stats.NO_ESTIMATE
    groups = list(pairs["difficulty"]) if macro else None
    blocks = (pairs["block_method"].astype(str) + "|" + pairs["block_baseline"].astype(str)).tolist()
    with np.errstate(divide="ignore", invalid="ignore"):  # a draw in which the baseline's mean is 0
        ratio = stats.speedup(method, baseline, list(pairs["task"]), groups, blocks)
    return ratio if math.isfinite(ratio.low + ratio.high) else Estimate(ratio.value, math.nan, math.nan)


def why_different(row: dict[str, Any], reference: dict[str, Any]) -> str:
    """Why a row's speed per episode differs from that per control step, in one line; empty where their intervals
    overlap.

    Args:
        row, reference: a row of a study's table and its baseline's.
    """
    names = ("episode_speedup", "episode_speedup_low", "episode_speedup_high", "speedup", "speedup_low", "speedup_high")
    episode, low, high, step, step_low, step_high = (float(row[name]) for name in names)
    if math.isnan(low + high + step_low + step_high) or (low <= step_high and step_low <= high):
        return ""
    lengths = [r["steps"] / r["episodes"] for r in (row, reference)]
    failures = [r["episodes"] / max(1, r["repeats"]) - r["successes"] for r in (row, reference)]
    reasons = [f"{lengths[0]:.0f} control steps an episode instead of {lengths[1]:.0f}"]
    if failures[0] != failures[1]:
        more = "more" if failures[0] > failures[1] else "fewer"
        reasons.append(f"{more} failures, which run to the horizon ({failures[0]:.0f} instead of {failures[1]:.0f})")
    if abs(lengths[0] / lengths[1] - 1) < _SAME:
        reasons.append("its time per step is lower in short episodes than in long ones" if episode < step
                       else "its time per step is lower in long episodes than in short ones")  # fmt: skip
    return f"{row['label']}: {episode:.2f} per episode, {step:.2f} per step: {', '.join(reasons)}"


_SAME = 0.02


def differences(rows: list[dict[str, Any]]) -> list[str]:
    """`why_different` of all rows of a study's table, those without a reason left out."""
    by_label = {row["label"]: row for row in rows}
    reasons = [why_different(row, by_label[row["baseline"]]) for row in rows if row["baseline"] in by_label]
    return [reason for reason in reasons if reason]
