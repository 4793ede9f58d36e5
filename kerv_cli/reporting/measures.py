"""The quantities of docs/methods.md §7, from episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from kerv_cli.decoding.record import PHASES
from kerv_cli.reporting import statistics as stats
from kerv_cli.reporting.statistics import Estimate

MICRO = "micro over tasks"
MARGIN = 0.03  # of success: a method is non-inferior where the difference's lower bound lies above -MARGIN
MACRO = "macro over difficulty groups"

COMPARABLE = ("device", "device_name", "dtype", "threads")  # what times must agree in to be compared
_SAME = (*COMPARABLE, "initial_state")  # what two episodes of a pair must agree in

_RATIOS = {
    "AL": ("committed", "verifications"),
    "accepted_per_round": ("accepted", "verifications"),
    "AFEP": ("first_rejected_sum", "first_rejected_count"),
    "forwards_per_step": ("forwards", "steps"),
    "skip_rate": ("skipped_decodes", "decodes"),
    "unverified_share": ("unverified_tokens", "executed_tokens"),
    "compensation_rate": ("compensated_decodes", "decodes"),
    "retrieval_share": ("retrieval_decodes", "decodes"),
    "deviation": ("deviation_sum", "deviation_count"),
}
"""Quotients of sums over episodes; NaN where there was nothing to divide by."""


@dataclass(frozen=True)
class Measured:
    """One setting over some episodes."""

    values: dict[str, float]  # every measure but those below
    success: Estimate  # Wilson interval
    speedup: Estimate  # of time per step; bootstrap interval; NaN without pairs, and where no target decodes
    episode_speedup: Estimate  # of time per episode, likewise: methods also change how long episodes are
    counts: stats.PairedCounts
    mcnemar_p: float  # NaN without pairs
    difference: Estimate  # of success, method minus baseline, over all pairs
    pairs_to_settle: float  # about how many pairs would show non-inferiority at MARGIN
    same_run: bool  # all pairs were measured in one run
    same_block: float  # share of the pairs that were measured in one block, in turn; NaN without pairs


def measure(episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str) -> Measured:
    """Every measure of a setting's episodes, pooled (`MICRO`, or one task) or averaged over difficulty (`MACRO`).

    MACRO takes each measure within every difficulty group and then the unweighted mean of the groups; the speedup is
    the ratio of the two macro means. Paired counts and p are no averages: they are those of all pairs.

    Args:
        episodes: the setting's, columns of rows.EPISODE_SCHEMA, decode_seconds, difficulty, run and those of `_SAME`.
        baseline: the baseline's, same columns; only pairs of equal task, seed, repeat, world and device are compared.
    """
    pairs = paired(episodes, baseline)
    macro = averaging == MACRO
    once = pairs[pairs["repeat"] == 0]  # a repeat of an episode is another time, not another world
    counts = stats.paired_counts(once["success_baseline"].to_numpy(), once["success_method"].to_numpy())
    decodes = _decodes(episodes)
    return Measured(
        values=_by_group(episodes, _means) if macro else _means(episodes),
        success=_success(episodes[episodes["repeat"] == 0], macro),
        speedup=_speedup(pairs, "time", macro) if decodes else stats.NO_ESTIMATE,
        episode_speedup=_speedup(pairs, "seconds", macro) if decodes else stats.NO_ESTIMATE,
        counts=counts,
        mcnemar_p=stats.mcnemar(counts) if len(pairs) else math.nan,
        difference=stats.paired_difference(counts),
        pairs_to_settle=stats.pairs_to_settle(counts, MARGIN),
        same_run=bool(len(pairs) and pairs["same_run"].all()),
        same_block=float(pairs["same_block"].mean()) if len(pairs) else math.nan,
    )


def paired(episodes: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Pairs of equal task, seed, repeat, initial state and device, sorted by task, seed and repeat.

    Columns: task, difficulty, seed, repeat; with the suffixes _baseline and _method: time (seconds per step), seconds
    (of the episode), success, block; same_run, same_block.
    """
    keys = ["task", "seed", "repeat"]
    columns = [*keys, "difficulty", "run", "block", "success", "seconds", *_SAME]
    method = episodes[columns].assign(time=episodes["seconds"] / episodes["steps"])
    other = baseline[columns].assign(time=baseline["seconds"] / baseline["steps"])
    both = method.merge(other, on=keys, suffixes=("_method", "_baseline"))
    agree = pd.Series(True, index=both.index)
    for name in _SAME:
        agree &= both[f"{name}_method"] == both[f"{name}_baseline"]
    both = both[agree].sort_values(keys, kind="stable").reset_index(drop=True)
    both["same_run"] = both["run_method"] == both["run_baseline"]
    both["same_block"] = (both["block_method"] == both["block_baseline"]) & (both["block_method"] != "")
    return both.rename(columns={"difficulty_method": "difficulty"})


def _decodes(episodes: pd.DataFrame) -> bool:
    """Whether a target decodes at all. The scripted expert's time is no speedup of any decoding method."""
    return bool(episodes["forwards"].sum() or episodes["skipped_decodes"].sum())


def _speedup(pairs: pd.DataFrame, time: str, macro: bool) -> Estimate:
    blocks = pairs["block_method"].astype(str) + "|" + pairs["block_baseline"].astype(str)
    return stats.speedup(
        pairs[f"{time}_baseline"].to_numpy(),
        pairs[f"{time}_method"].to_numpy(),
        list(pairs["task"]),
        list(pairs["difficulty"]) if macro else None,
        list(blocks),
    )


def _means(episodes: pd.DataFrame) -> dict[str, float]:
    per_step = 1000.0 / episodes["steps"]
    values = {
        "time_per_step_ms": float((episodes["seconds"] * per_step).mean()),
        "time_per_episode_ms": 1000.0 * float(episodes["seconds"].mean()),
        **_latencies(episodes["decode_seconds"]),
        "gauge_ms": 1000.0 * float(episodes["gauge_seconds"].median()),
    }
    values |= {f"ms.{phase}": float((episodes[f"seconds.{phase}"] * per_step).mean()) for phase in PHASES}
    sums = {name: float(episodes[name].sum()) for pair in _RATIOS.values() for name in pair}
    values |= {name: sums[a] / sums[b] if sums[b] else math.nan for name, (a, b) in _RATIOS.items()}
    return values


def _latencies(decode_seconds: pd.Series) -> dict[str, float]:
    """Milliseconds from an observation to its actions, over all decodes of all episodes."""
    times = 1000.0 * np.concatenate(list(decode_seconds))
    middle, late, worst = np.quantile(times, [0.5, 0.95, 1.0])
    return {"latency_p50_ms": float(middle), "latency_p95_ms": float(late), "latency_worst_ms": float(worst)}


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
