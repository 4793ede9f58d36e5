"""Compute the measures of docs/methods.md §7 from stored episodes (rows of the database's table `episodes`)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from kerv_cli.base.registry import ColumnPart
from kerv_cli.engine.record import PHASES
from kerv_cli.report import statistics as stats
from kerv_cli.report.results import MACRO, MICRO, RATIO, Measures
from kerv_cli.report.statistics import Estimate

NEAR = 0.02
"""Distance between hand and object, in metres, below which a failed episode counts as a near-contact failure."""
MARGIN = 0.03
"""Loss of success, as a share of episodes, below which a setting counts as non-inferior to the baseline."""

COMPARABLE = ("device", "device_name", "dtype", "threads")
"""Columns in which two episodes must agree before their times are compared."""

_RATIOS = {one.name: one.metadata[RATIO] for one in fields(Measures) if RATIO in one.metadata}
"""Measure -> (numerator, denominator), each a column summed over episodes. NaN if the denominator is 0."""
_PHASES = [f"ms.{phase}" for phase in PHASES]


def measure(
    episodes: pd.DataFrame,
    pairs: pd.DataFrame,
    by: Sequence[str] = ("label",),
    averaging: str = MICRO,
    all_pairs: bool = False,
) -> dict[Hashable, Measures]:
    """Return every measure of each group of episodes.

    Args:
        episodes: One row per episode. Columns: those of rows.EPISODE_SCHEMA, `label`, `decode_seconds`, `difficulty`,
            `run`, `block`, and those of `COMPARABLE`.
        pairs: Pairs of these episodes with the baseline's episodes, from `paired`.
        by: Columns that form the groups: the label, or task and label.
        averaging: MACRO computes a measure for every difficulty group and returns the unweighted mean of the groups.
            Any other value pools all episodes. Paired counts, McNemar's p and `pairs_to_settle` are always pooled.
        all_pairs: Whether speedups also use pairs that were not measured in one block (side by side in one process).

    Returns:
        The measures by group.
    """
    if averaging != MACRO:
        episodes, pairs = episodes.assign(difficulty=""), pairs.assign(difficulty="")
    by, outcomes = list(by), list(stats.PairedCounts._fields)
    parts = [*by, "difficulty"]
    worlds = episodes["repeat"] == 0  # a repeat measures the same world again
    counted = episodes.assign(worlds=worlds, successes=worlds & episodes["success"].astype(bool))
    counts = counted.groupby(parts)[["successes", "worlds", "steps", "decodes", "deviation_count"]].sum()
    counts = counts.join(pairs.groupby(parts)[outcomes].sum()).fillna(0).astype(int)
    means = _means(episodes, parts).groupby(level=by).mean().join(pairs.groupby(by)[["same_run", "same_block"]].mean())
    speeds = speedups(pairs, by, averaging, all_pairs)
    measured: dict[Hashable, Measures] = {}
    found: dict[Any, Any] = means.to_dict("index")
    for group, others in found.items():
        part = counts.loc[group, :]  # a row per difficulty group
        rates = list(itertools.starmap(stats.wilson, part[["successes", "worlds"]].to_numpy().tolist()))
        pairings = itertools.starmap(stats.PairedCounts, part[outcomes].to_numpy().tolist())
        changes = list(map(stats.paired_difference, pairings))
        sums = part.sum().to_dict()
        pooled = stats.PairedCounts(*map(sums.__getitem__, outcomes))
        measured[group] = Measures(
            successes=sums["successes"],
            success=stats.mean_of(rates),
            phases={name: others.pop(name) for name in _PHASES},
            added={name: others.pop(name) for name in registered_columns()},
            same_run=others.pop("same_run") == 1,
            **others,
            **compared(pooled, stats.mean_of(changes)),
            pairs_to_settle=stats.pairs_to_settle(pooled, MARGIN),
            steps=sums["steps"],
            decodes=sums["decodes"],
            deviation_samples=sums["deviation_count"],
            **speeds.get(group, Speeds())._asdict(),
        )
    return measured


def compared(counts: stats.PairedCounts, difference: Estimate) -> dict[str, Any]:
    """Return the fields of `Measures` that compare a setting's success with the baseline's.

    Args:
        counts: Outcomes of the pairs.
        difference: Success rate of the setting minus the baseline's, with its interval.
    """
    return {
        "counts": counts,
        "mcnemar_p": stats.mcnemar(counts) if sum(counts) else math.nan,
        "difference": difference,
        "margin": MARGIN,
        "non_inferior": bool(difference.low > -MARGIN),
    }


def paired(episodes: pd.DataFrame, baselines: Mapping[str, str]) -> pd.DataFrame:
    """Pair each setting's episodes with the episodes of its baseline.

    Two episodes form a pair if they have the same task, seed, repeat, initial state, device, number format and number
    of threads. Episodes that were run by a foreign policy server name no device; they pair with episodes of any device.

    Args:
        episodes: Episodes of all settings and baselines.
        baselines: Maps a setting's label to the label of its baseline. Other settings are left out.

    Returns:
        One row per pair, sorted by task, seed and repeat. It has these columns:

        - `label`, `task`, `difficulty`, `seed`, `repeat`, `decodes` (whether the setting runs a decoder), `same_run`
          and `same_block`
        - for each side, with the ending _baseline or _method: `time` (seconds per control step), `seconds` (of the
          whole episode), `block` and `success`
        - the four outcomes of `PairedCounts`: 1 for the outcome of this pair, 0 for the others. In repeats, which
          measure the same world again, all are 0.
    """
    keys = ["task", "seed", "repeat"]
    columns = ["label", *keys, "run", "block", "success", "seconds", "initial_state", *COMPARABLE]
    other = episodes[columns].assign(time=episodes["seconds"] / episodes["steps"])
    method = other.assign(
        difficulty=episodes["difficulty"],
        decodes=(episodes["forwards"] > 0) | (episodes["skipped_decodes"] > 0),  # a scripted expert does neither
        baseline=other["label"].map(baselines),
    )
    other = other.rename(columns={"label": "baseline"})
    both = method.merge(other, on=["baseline", *keys], suffixes=("_method", "_baseline"))
    agree = both["initial_state_method"] == both["initial_state_baseline"]
    elsewhere = (both["device_name_method"] == "") | (both["device_name_baseline"] == "")
    for name in COMPARABLE:
        agree &= elsewhere | (both[f"{name}_method"] == both[f"{name}_baseline"])
    both = both[agree].sort_values(keys, kind="stable").reset_index(drop=True)
    won, reference = both["success_method"].astype(bool), both["success_baseline"].astype(bool)
    outcomes = {"both": won & reference, "only_baseline": ~won & reference, "only_method": won & ~reference}
    outcomes["neither"] = ~won & ~reference
    return both.assign(
        same_run=both["run_method"] == both["run_baseline"],
        same_block=both["block_method"] == both["block_baseline"],
        **{name: (outcome & (both["repeat"] == 0)).astype(int) for name, outcome in outcomes.items()},
    )


class Speeds(NamedTuple):
    """Speedups of a group of pairs: mean time of the baseline ÷ mean time of the method.

    Attributes:
        speedup: Ratio of the mean seconds per control step.
        episode_speedup: Ratio of the mean seconds per episode.
        solved_speedup: Ratio of the mean seconds per episode, over the pairs that both solved. A failed episode runs to
            the horizon, so a single one can decide the other two ratios.
    """

    speedup: Estimate = stats.NO_ESTIMATE
    episode_speedup: Estimate = stats.NO_ESTIMATE
    solved_speedup: Estimate = stats.NO_ESTIMATE


def speedups(pairs: pd.DataFrame, by: list[str], averaging: str, all_pairs: bool = False) -> dict[Hashable, Speeds]:
    """Return the speedups of each group of pairs.

    A group is left out if it has no usable pairs, if an episode was not timed, or if its setting runs no decoder (the
    scripted expert).

    Args:
        pairs: Table made by `paired`.
        by: Columns that form the groups.
        averaging: MACRO: a mean time is the mean of the difficulty groups' means. Otherwise: the mean of all pairs.
        all_pairs: Whether to use pairs that were not measured in one block (side by side in one process), too.
    """
    timed = pairs if all_pairs else pairs[pairs["same_block"]]
    blocks = timed["block_method"].astype(str) + "|" + timed["block_baseline"].astype(str)
    # repeats of a world count once
    blocks = blocks.groupby([timed["label"], timed["task"], timed["seed"]]).transform("first")
    tasks, clusters = pd.factorize(timed["task"])[0], pd.factorize(blocks)[0]
    difficulties = pd.factorize(timed["difficulty"])[0] if averaging == MACRO else np.zeros(len(timed), int)
    decodes = timed["decodes"].to_numpy()
    solved = (timed["success_baseline"].astype(bool) & timed["success_method"].astype(bool)).to_numpy()

    def ratio(column: str, index: np.ndarray) -> Estimate:
        baseline, method = timed[f"{column}_baseline"].to_numpy(float), timed[f"{column}_method"].to_numpy(float)
        return stats.speedup(baseline[index], method[index], tasks[index], difficulties[index], clusters[index])

    untimed = timed["seconds_baseline"].isna().to_numpy() | timed["seconds_method"].isna().to_numpy()
    found = {}
    for group, members in timed.groupby(by).indices.items():
        index = np.asarray(members)
        if decodes[index].any() and not untimed[index].any():
            solved_by_both = index[solved[index]]
            found[group] = Speeds(ratio("time", index), ratio("seconds", index), ratio("seconds", solved_by_both))
    return found


def _means(episodes: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Return the measures that need no baseline, pooled over the episodes of each group. Times are in milliseconds."""
    groups = episodes.groupby(by)
    per_step, solved = 1000.0 / episodes["steps"], episodes["success"].astype(bool)
    distances = episodes["closest_approach"].astype(float)
    each = {
        "time_per_step_ms": episodes["seconds"] * per_step,
        "time_per_episode_ms": 1000.0 * episodes["seconds"],
        **{f"ms.{phase}": episodes[f"seconds.{phase}"] * per_step for phase in PHASES},
        "steps_to_success": episodes["steps"].where(solved),
        "path_m": episodes["path_length"].astype(float).where(solved),
        "jerk": episodes["jerk"].astype(float),
        "near_contact_failure": (distances < NEAR).astype(float).where(~solved & distances.notna()),
    }
    quantiles = {"latency_p50_ms": 0.5, "latency_p95_ms": 0.95, "latency_worst_ms": 1.0}
    latencies = []
    for _, arrays in groups["decode_seconds"]:
        milliseconds = 1000.0 * np.concatenate(list(arrays))
        latencies.append(np.quantile(milliseconds, list(quantiles.values())))
    percentiles = dict(zip(quantiles, np.transpose(latencies), strict=True))
    means = episodes[by].assign(**each).groupby(by).mean().assign(**percentiles)
    sums = groups[list(dict.fromkeys(itertools.chain.from_iterable(_RATIOS.values())))].sum()
    for name, (above, below) in _RATIOS.items():
        means[name] = sums[above] / sums[below].mask(sums[below] == 0)
    means["felt_latency_ms"] *= 1000.0
    for name, part in registered_columns().items():
        means[name] = [float(part.built(group)) for _, group in groups]
    return means


def registered_columns() -> Mapping[str, ColumnPart]:
    """Return the table columns that plugins add, by name.

    `ColumnPart.built` computes the column's value from the episodes of a setting.
    """
    return ColumnPart.every()
