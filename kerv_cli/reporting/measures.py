"""The quantities of METHODS §7, from episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pandas as pd

from kerv_cli.decoding.record import PHASES
from kerv_cli.reporting import statistics as stats
from kerv_cli.reporting.statistics import Estimate

MICRO = "micro over tasks"
MACRO = "macro over difficulty groups"

COMPARABLE = ("device", "device_name", "dtype", "threads")  # what times must agree in to be compared
_SAME = (*COMPARABLE, "initial_state")  # what two episodes of a pair must agree in

_RATIOS = {
    "AL": ("committed", "verifications"),
    "accepted_per_round": ("accepted", "verifications"),
    "AFEP": ("first_rejected_sum", "first_rejected_count"),
    "forwards_per_step": ("forwards", "steps"),
    "skip_rate": ("skipped_decodes", "decodes"),
    "compensation_rate": ("compensated_decodes", "decodes"),
    "retrieval_share": ("retrieval_decodes", "decodes"),
    "deviation": ("deviation_sum", "deviation_count"),
}
"""Quotients of sums over episodes; NaN where there was nothing to divide by."""


@dataclass(frozen=True)
class Measured:
    """One setting over some episodes."""

    values: dict[str, float]  # every measure but the two below
    success: Estimate  # Wilson interval
    speedup: Estimate  # bootstrap interval; NaN without pairs, and where no target decodes
    counts: stats.PairedCounts
    mcnemar_p: float  # NaN without pairs
    same_run: bool  # all pairs were measured in one run


def measure(episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str) -> Measured:
    """Every measure of a setting's episodes, pooled (`MICRO`, or one task) or averaged over difficulty (`MACRO`).

    MACRO takes each measure within every difficulty group and then the unweighted mean of the groups; the speedup is
    the ratio of the two macro means. Paired counts and p are no averages: they are those of all pairs.

    Args:
        episodes: the setting's, columns of rows.EPISODE_SCHEMA and task, difficulty, run and the columns of `_SAME`.
        baseline: the baseline's, same columns; only pairs of equal task, seed, world and device are compared.
    """
    pairs = paired(episodes, baseline)
    macro = averaging == MACRO
    counts = stats.paired_counts(pairs["success_baseline"].to_numpy(), pairs["success_method"].to_numpy())
    return Measured(
        values=_by_group(episodes, _means) if macro else _means(episodes),
        success=_success(episodes, macro),
        speedup=_speedup(pairs, macro) if _decodes(episodes) else stats.NO_ESTIMATE,
        counts=counts,
        mcnemar_p=stats.mcnemar(counts) if len(pairs) else math.nan,
        same_run=bool(len(pairs) and pairs["same_run"].all()),
    )


def paired(episodes: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Pairs of equal task, seed, initial state and device, sorted by task and seed.

    Columns: task, difficulty, seed, time_baseline and time_method (seconds per step), success_baseline and
    success_method, same_run.
    """
    keys = ["task", "seed"]
    columns = [*keys, "difficulty", "run", "success", *_SAME]
    method = episodes[columns].assign(time=episodes["seconds"] / episodes["steps"])
    other = baseline[columns].assign(time=baseline["seconds"] / baseline["steps"])
    both = method.merge(other, on=keys, suffixes=("_method", "_baseline"))
    agree = pd.Series(True, index=both.index)
    for name in _SAME:
        agree &= both[f"{name}_method"] == both[f"{name}_baseline"]
    both = both[agree].sort_values(keys, kind="stable").reset_index(drop=True)
    both["same_run"] = both["run_method"] == both["run_baseline"]
    return both.rename(columns={"difficulty_method": "difficulty"})


def _decodes(episodes: pd.DataFrame) -> bool:
    """Whether a target decodes at all. The scripted expert's time is no speedup of any decoding method."""
    return bool(episodes["forwards"].sum() or episodes["skipped_decodes"].sum())


def _speedup(pairs: pd.DataFrame, macro: bool) -> Estimate:
    times = pairs["time_baseline"].to_numpy(), pairs["time_method"].to_numpy()
    return stats.speedup(*times, list(pairs["task"]), list(pairs["difficulty"]) if macro else None)


def _means(episodes: pd.DataFrame) -> dict[str, float]:
    per_step = 1000.0 / episodes["steps"]
    values = {"time_per_step_ms": float((episodes["seconds"] * per_step).mean())}
    values |= {f"ms.{phase}": float((episodes[f"seconds.{phase}"] * per_step).mean()) for phase in PHASES}
    sums = {name: float(episodes[name].sum()) for pair in _RATIOS.values() for name in pair}
    values |= {name: sums[a] / sums[b] if sums[b] else math.nan for name, (a, b) in _RATIOS.items()}
    return values


def _by_group(episodes: pd.DataFrame, measure_of: Callable[[pd.DataFrame], dict[str, float]]) -> dict[str, float]:
    """Unweighted mean over difficulty groups; a group that has no value of a measure is left out of its mean."""
    groups = pd.DataFrame([measure_of(group) for _, group in episodes.groupby("difficulty", sort=True)])
    return {str(name): float(value) for name, value in groups.mean().items()}


def _success(episodes: pd.DataFrame, macro: bool) -> Estimate:
    grouped = [group["success"] for _, group in episodes.groupby("difficulty", sort=True)] if macro else []
    parts: Sequence[pd.Series] = grouped or [episodes["success"]]
    counted = [(int(part.sum()), len(part)) for part in parts]
    rate = sum(successes / episodes_ for successes, episodes_ in counted) / len(counted)
    return Estimate(rate, *(stats.macro_wilson(counted) if macro else stats.wilson(*counted[0])))
