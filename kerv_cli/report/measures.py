"""The measures of docs/methods.md §7, from rows of the table `episodes`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from kerv_cli.base.registry import Part, parts
from kerv_cli.engine.record import PHASES
from kerv_cli.report import statistics as stats
from kerv_cli.report.statistics import Estimate

Row = dict[str, Any]
"""One row of a table by column."""

MICRO = "micro over tasks"
MACRO = "macro over difficulty groups"
MARGIN = 0.03  # of success: a method is non-inferior where the difference's lower bound lies above -MARGIN

COMPARABLE = ("device", "device_name", "dtype", "threads")  # columns that must be equal for times to be comparable
_SAME = (*COMPARABLE, "initial_state")  # columns that must be equal in the two episodes of a pair

MOTION = {"steps_to_success": "steps", "path_m": "path_length"}
"""Measure of an episode besides inference -> column of rows.EPISODE_SCHEMA."""

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
    "felt_latency": ("delay_seconds", "delay_decodes"),
    "felt_latency_steps": ("delay_steps", "delay_decodes"),
    "held_share": ("held_steps", "steps"),
}
"""Quotients of sums over episodes; NaN where the denominator is 0."""


def measure(episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str, apart: bool = False) -> Row:
    """Every measure of a setting's episodes, pooled (`MICRO`, or one task) or averaged over difficulty (`MACRO`).

    success has a Wilson interval. speedup is that of the time per step, episode_speedup that of the time per episode
    (methods also change the length of episodes); they are NaN without pairs, where no target decodes and where an
    episode of either side was not timed. They count only the pairs that were measured in turn in one block; with
    apart=True all pairs. mcnemar_p is NaN without pairs. same_run: all pairs were measured in one run. same_block:
    share of the pairs that were measured in one block.

    MACRO takes each measure within every difficulty group and then the unweighted mean of the groups, intervals
    included; the speedup is the ratio of the two macro means. Paired counts, p and pairs_to_settle are those of all
    pairs in either case.

    Args:
        episodes: the setting's, columns of rows.EPISODE_SCHEMA, decode_seconds, difficulty, run and those of `_SAME`.
        baseline: the baseline's, same columns; only pairs of equal task, seed, repeat, world and device are compared.
    """
    pairs = paired(episodes, baseline)
    macro = averaging == MACRO
    worlds = pairs[pairs["repeat"] == 0]  # a repeat is another time, not another world
    once = episodes[episodes["repeat"] == 0]
    timed = pairs if apart else pairs[pairs["same_block"]]
    has_times = decodes(episodes) and is_timed(timed, "time_method") and is_timed(timed, "time_baseline")
    return {
        "successes": int(once["success"].sum()),
        **columns_of("success", _averaged(once, macro, _success)),
        **columns_of("speedup", _speedup(timed, "time", macro) if has_times else stats.NO_ESTIMATE),
        **columns_of("episode_speedup", _speedup(timed, "seconds", macro) if has_times else stats.NO_ESTIMATE),
        **(_by_group(episodes, _means) if macro else _means(episodes)),
        **columns_of("AL", _averaged(episodes, macro, _acceptance_length)),
        **paired_columns(
            pair_counts(worlds), _averaged(worlds, macro, lambda part: stats.paired_difference(pair_counts(part)))
        ),
        "pairs_to_settle": stats.pairs_to_settle(pair_counts(worlds), MARGIN),
        "same_run": bool(len(pairs) and pairs["same_run"].all()),
        "same_block": float(pairs["same_block"].mean()) if len(pairs) else math.nan,
        "steps": int(episodes["steps"].sum()),
        "decodes": int(episodes["decodes"].sum()),
        "deviation_samples": int(episodes["deviation_count"].sum()),
        **_motion(episodes, pairs, macro),
    }


def _motion(episodes: pd.DataFrame, pairs: pd.DataFrame, macro: bool) -> dict[str, float]:
    """Of the successful episodes: the mean of every measure of `MOTION`, and its ratio to the baseline's over the pairs
    in which both succeeded, with its interval. NaN where a measure is unknown, without such pairs, and where
    the baseline's mean is 0."""
    successes = episodes[episodes["success"].astype(bool)]
    both = pairs[pairs["success_method"].astype(bool) & pairs["success_baseline"].astype(bool)]
    columns: dict[str, float] = {}
    for name, column in MOTION.items():
        values = successes[column].astype(float)
        groups = values.groupby(successes["difficulty"]).mean() if macro else values
        columns[name] = math.nan if values.empty or values.isna().any() else float(groups.mean())
        columns |= columns_of(f"{name}_ratio", _motion_ratio(both, column, macro))
    return columns


def _motion_ratio(pairs: pd.DataFrame, column: str, macro: bool) -> Estimate:
    method, baseline = (
        pairs[f"{column}_{side}"].to_numpy(dtype=float, na_value=np.nan) for side in ("method", "baseline")
    )
    if not len(method) or np.isnan([*method, *baseline]).any() or not baseline.sum():
        return stats.NO_ESTIMATE
    groups = list(pairs["difficulty"]) if macro else None
    with np.errstate(divide="ignore", invalid="ignore"):  # the method's mean may be 0
        ratio = stats.speedup(method, baseline, list(pairs["task"]), groups, _blocks(pairs).tolist())
    return ratio if math.isfinite(ratio.low + ratio.high) else Estimate(ratio.value, math.nan, math.nan)


def _blocks(pairs: pd.DataFrame) -> pd.Series:
    return pairs["block_method"].astype(str) + "|" + pairs["block_baseline"].astype(str)


def _averaged(frame: pd.DataFrame, macro: bool, estimate: Callable[[pd.DataFrame], Estimate]) -> Estimate:
    """An estimate of the whole frame, or the mean of the difficulty groups that have one, with its interval."""
    if not macro:
        return estimate(frame)
    estimates = [estimate(group) for _, group in frame.groupby("difficulty", sort=True)]
    return stats.mean_of([one for one in estimates if not math.isnan(one.value)])


def _success(episodes: pd.DataFrame) -> Estimate:
    return stats.wilson(int(episodes["success"].sum()), len(episodes))


def _acceptance_length(episodes: pd.DataFrame) -> Estimate:
    """AL with an interval by task and seed; NaN without verifications."""
    if not episodes["verifications"].sum():
        return stats.NO_ESTIMATE
    tasks, seeds = list(episodes["task"]), list(episodes["seed"])
    return stats.ratio(episodes["committed"].to_numpy(), episodes["verifications"].to_numpy(), tasks, seeds)


def pair_counts(pairs: pd.DataFrame) -> stats.PairedCounts:
    """Counts of pairs, rows of `paired`, by success of the baseline and of the method."""
    return stats.paired_counts(pairs["success_baseline"].to_numpy(), pairs["success_method"].to_numpy())


def paired_columns(counts: stats.PairedCounts, difference: Estimate | None = None) -> Row:
    """Columns on the success of paired episodes: their number and counts, McNemar's p (NaN without pairs), the
    difference with its interval, by default that of the counts, and whether the interval lies above minus the
    margin."""
    difference = difference or stats.paired_difference(counts)
    return {
        "pairs": sum(counts),
        **counts._asdict(),
        "mcnemar_p": stats.mcnemar(counts) if sum(counts) else math.nan,
        **columns_of("difference", difference),
        "margin": MARGIN,
        "non_inferior": bool(difference.low > -MARGIN),
    }


def columns_of(name: str, estimate: Estimate) -> dict[str, float]:
    """Columns of an estimate: its value under the name, and its interval with the endings _low and _high."""
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def paired(episodes: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Pairs of equal task, seed, repeat, initial state and device, sorted by task, seed and repeat. Episodes that were
    served by others than kerv name no device, have no times and pair with those of any.

    Columns: task, difficulty, seed, repeat; with the suffixes _baseline and _method: time (seconds per step), seconds
    (of the episode), success, block and the columns of `MOTION`; same_run, same_block.
    """
    keys = ["task", "seed", "repeat"]
    columns = [*keys, "difficulty", "run", "block", "success", "seconds", *MOTION.values(), *_SAME]
    method = episodes[columns].assign(time=episodes["seconds"] / episodes["steps"])
    other = baseline[columns].assign(time=baseline["seconds"] / baseline["steps"])
    both = method.merge(other, on=keys, suffixes=("_method", "_baseline"))
    agree = both["initial_state_method"] == both["initial_state_baseline"]
    elsewhere = (both["device_name_method"] == "") | (both["device_name_baseline"] == "")  # on a device without a name
    for name in COMPARABLE:
        agree &= elsewhere | (both[f"{name}_method"] == both[f"{name}_baseline"])
    both = both[agree].sort_values(keys, kind="stable").reset_index(drop=True)
    both["same_run"] = both["run_method"] == both["run_baseline"]
    both["same_block"] = both["block_method"] == both["block_baseline"]
    return both.rename(columns={"difficulty_method": "difficulty"})


def decodes(episodes: pd.DataFrame) -> bool:
    """Whether a target decodes at all; a scripted expert has no decoding time to compare."""
    return bool(episodes["forwards"].sum() or episodes["skipped_decodes"].sum())


def is_timed(episodes: pd.DataFrame, column: str = "seconds") -> bool:
    """Whether all episodes have times; those of a batch have none (docs/measuring.md)."""
    return bool(episodes[column].notna().all())


def _speedup(pairs: pd.DataFrame, time: str, macro: bool) -> Estimate:
    blocks = (
        _blocks(pairs).groupby([pairs["task"], pairs["seed"]]).transform("first")
    )  # repeats of a world belong together
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
    }
    phases = episodes[[f"seconds.{phase}" for phase in PHASES]].mul(per_step, axis=0).mean()
    values |= {f"ms.{phase}": float(phases[f"seconds.{phase}"]) for phase in PHASES}
    sums = episodes[list({name: 0 for pair in _RATIOS.values() for name in pair})].sum().to_dict()
    values |= {name: float(sums[a] / sums[b]) if sums[b] else math.nan for name, (a, b) in _RATIOS.items()}
    values["felt_latency_ms"] = 1000.0 * values.pop("felt_latency")
    return values | {name: float(part.built(episodes)) for name, part in registered_columns().items()}


def registered_columns() -> Mapping[str, Part]:
    """Columns that a plug-in adds, by name: functions of a setting's episodes."""
    return parts("column")


def _latencies(decode_seconds: pd.Series) -> dict[str, float]:
    """Milliseconds from an observation to its actions, over all decodes of all episodes."""
    times = 1000.0 * np.concatenate(list(decode_seconds))
    middle, late, worst = np.quantile(times, [0.5, 0.95, 1.0])
    return {"latency_p50_ms": float(middle), "latency_p95_ms": float(late), "latency_worst_ms": float(worst)}


def _by_group(episodes: pd.DataFrame, measure_of: Callable[[pd.DataFrame], dict[str, float]]) -> dict[str, float]:
    """Unweighted means over difficulty groups; groups without a value of a measure are left out of its mean."""
    groups = pd.DataFrame([measure_of(group) for _, group in episodes.groupby("difficulty", sort=True)])
    return {str(name): float(value) for name, value in groups.mean().items()}
