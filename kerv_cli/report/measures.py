"""Compute the measures of docs/methods.md §7 from stored episodes (rows of the database's table `episodes`)."""

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
"""One row of a table: column name to value."""

MICRO = "micro over tasks"
MACRO = "macro over difficulty groups"
NEAR = 0.02
"""Distance between hand and object, in metres, below which a failed episode counts as a near-contact failure."""
MARGIN = 0.03
"""Loss of success, as a share of episodes, below which a setting counts as non-inferior to the baseline."""

COMPARABLE = ("device", "device_name", "dtype", "threads")
"""Columns in which two episodes must agree before their times are compared."""

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
"""Measure -> (numerator, denominator), each a column summed over episodes. NaN if the denominator is 0."""


def measure(episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str, all_pairs: bool = False) -> Row:
    """Return every measure of a setting.

    `speedup` compares the time per control step, `episode_speedup` the time per episode. Both are NaN if there are no
    usable pairs, if an episode was not timed, or if the setting runs no decoder (the scripted expert). `same_run` says
    whether the two episodes of every pair come from one run. `same_block` is the share of pairs that were measured
    in one block (side by side in one process).

    Args:
        episodes: Episodes of the setting, one per row. Columns: those of rows.EPISODE_SCHEMA, `decode_seconds`,
            `difficulty`, `run`, and those of `COMPARABLE`.
        baseline: Episodes of the baseline, with the same columns. May be empty.
        averaging: MACRO computes a measure for every difficulty group and returns the unweighted mean of the groups.
            Any other value pools all episodes. Paired counts, McNemar's p and `pairs_to_settle` are always pooled.
        all_pairs: Whether speedups also use pairs that were not measured in one block.

    Returns:
        Column name to value. A measure without data is NaN.
    """
    pairs = paired(episodes, baseline)
    macro = averaging == MACRO
    worlds = pairs[pairs["repeat"] == 0]  # a repeat measures the same world again
    once = episodes[episodes["repeat"] == 0]
    success = _averaged(once, macro, lambda group: stats.wilson(int(group["success"].sum()), len(group)))
    difference = _averaged(worlds, macro, lambda group: stats.paired_difference(pair_counts(group)))
    speeds = speedups(episodes, pairs, macro, all_pairs)
    return {
        "successes": int(once["success"].sum()),
        **columns_of("success", success),
        **columns_of("speedup", speeds["speedup"]),
        **columns_of("episode_speedup", speeds["episode_speedup"]),
        **(_mean_of_groups(episodes) if macro else _means(episodes)),
        **paired_columns(pair_counts(worlds), difference),
        "pairs_to_settle": stats.pairs_to_settle(pair_counts(worlds), MARGIN),
        "same_run": bool(len(pairs) and pairs["same_run"].all()),
        "same_block": float(pairs["same_block"].mean()) if len(pairs) else math.nan,
        "steps": int(episodes["steps"].sum()),
        "decodes": int(episodes["decodes"].sum()),
        "deviation_samples": int(episodes["deviation_count"].sum()),
    }


def _averaged(frame: pd.DataFrame, macro: bool, estimate: Callable[[pd.DataFrame], Estimate]) -> Estimate:
    """Apply `estimate` to all rows, or average its values over the difficulty groups.

    Args:
        frame: Episodes or pairs, with a column `difficulty`.
        macro: Whether to average over difficulty groups. Groups whose estimate is NaN are left out.
        estimate: Computes an estimate from some rows of `frame`.
    """
    if not macro:
        return estimate(frame)
    estimates = [estimate(group) for _, group in frame.groupby("difficulty", sort=True)]
    return stats.mean_of([one for one in estimates if not math.isnan(one.value)])


def pair_counts(pairs: pd.DataFrame) -> stats.PairedCounts:
    """Count how often both, one or none of the two sides succeeded, in a table made by `paired`."""
    return stats.paired_counts(pairs["success_baseline"].to_numpy(), pairs["success_method"].to_numpy())


def paired_columns(counts: stats.PairedCounts, difference: Estimate) -> Row:
    """Return the table columns that compare a setting's success with the baseline's.

    Args:
        counts: Outcomes of the pairs.
        difference: Success rate of the setting minus the baseline's, with its interval.

    Returns:
        Column name to value. `mcnemar_p` is NaN if there are no pairs.
    """
    return {
        "pairs": sum(counts),
        **counts._asdict(),
        "mcnemar_p": stats.mcnemar(counts) if sum(counts) else math.nan,
        **columns_of("difference", difference),
        "margin": MARGIN,
        "non_inferior": bool(difference.low > -MARGIN),
    }


def columns_of(name: str, estimate: Estimate) -> dict[str, float]:
    """Return an estimate as three columns: `name`, `name`_low and `name`_high."""
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def paired(episodes: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Pair the setting's episodes with the baseline's.

    Two episodes form a pair if they have the same task, seed, repeat, initial state, device, number format and number
    of threads. Episodes that were run by a foreign policy server name no device; they pair with episodes of any device.

    Returns:
        One row per pair, sorted by task, seed and repeat. Columns: `task`, `difficulty`, `seed`, `repeat`, `same_run`,
        `same_block`; and, with the endings _baseline and _method: `time` (seconds per control step), `seconds` (of the
        whole episode), `success`, `block`.
    """
    keys = ["task", "seed", "repeat"]
    columns = [*keys, "difficulty", "run", "block", "success", "seconds", "initial_state", *COMPARABLE]
    method, other = (side[columns].assign(time=side["seconds"] / side["steps"]) for side in (episodes, baseline))
    both = method.merge(other, on=keys, suffixes=("_method", "_baseline"))
    agree = both["initial_state_method"] == both["initial_state_baseline"]
    elsewhere = (both["device_name_method"] == "") | (both["device_name_baseline"] == "")
    for name in COMPARABLE:
        agree &= elsewhere | (both[f"{name}_method"] == both[f"{name}_baseline"])
    both = both[agree].sort_values(keys, kind="stable").reset_index(drop=True)
    both["same_run"] = both["run_method"] == both["run_baseline"]
    both["same_block"] = both["block_method"] == both["block_baseline"]
    return both.rename(columns={"difficulty_method": "difficulty"})


def decodes(episodes: pd.DataFrame) -> bool:
    """Return whether the episodes ran a decoder. A scripted expert runs none and has no decoding time."""
    return bool(episodes["forwards"].sum() or episodes["skipped_decodes"].sum())


def is_timed(episodes: pd.DataFrame, column: str = "seconds") -> bool:
    """Return whether `column` has a time for every episode.

    Episodes that ran in a batch have no times (docs/measuring.md).
    """
    return bool(episodes[column].notna().all())


def speedups(episodes: pd.DataFrame, pairs: pd.DataFrame, macro: bool, all_pairs: bool = False) -> dict[str, Estimate]:
    """Return `speedup` and `episode_speedup` of a setting, as `measure` defines them.

    Args:
        episodes: Episodes of the setting.
        pairs: Table made by `paired`.
        macro: Whether to average times over difficulty groups.
        all_pairs: Whether to use pairs that were not measured in one block, too.
    """
    timed = pairs if all_pairs else pairs[pairs["same_block"]]
    if not (decodes(episodes) and is_timed(timed, "time_method") and is_timed(timed, "time_baseline")):
        return {"speedup": stats.NO_ESTIMATE, "episode_speedup": stats.NO_ESTIMATE}
    blocks = timed["block_method"].astype(str) + "|" + timed["block_baseline"].astype(str)
    blocks = blocks.groupby([timed["task"], timed["seed"]]).transform("first")  # repeats of a world count once
    about = list(timed["task"]), list(timed["difficulty"]) if macro else None, list(blocks)
    return {
        name: stats.speedup(timed[f"{time}_baseline"].to_numpy(), timed[f"{time}_method"].to_numpy(), *about)
        for name, time in (("speedup", "time"), ("episode_speedup", "seconds"))
    }


def _means(episodes: pd.DataFrame) -> dict[str, float]:
    """Return the measures that need no baseline, pooled over all given episodes. Times are in milliseconds."""
    per_step = 1000.0 / episodes["steps"]
    decode_ms = 1000.0 * np.concatenate(list(episodes["decode_seconds"]))
    middle, late, worst = np.quantile(decode_ms, [0.5, 0.95, 1.0])
    values = {
        "time_per_step_ms": float((episodes["seconds"] * per_step).mean()),
        "time_per_episode_ms": 1000.0 * float(episodes["seconds"].mean()),
        "latency_p50_ms": float(middle),
        "latency_p95_ms": float(late),
        "latency_worst_ms": float(worst),
    }
    values |= {f"ms.{phase}": float((episodes[f"seconds.{phase}"] * per_step).mean()) for phase in PHASES}
    sums = episodes[list({name: 0 for pair in _RATIOS.values() for name in pair})].sum().to_dict()
    values |= {name: float(sums[a] / sums[b]) if sums[b] else math.nan for name, (a, b) in _RATIOS.items()}
    values["felt_latency_ms"] = 1000.0 * values.pop("felt_latency")
    solved = episodes[episodes["success"].astype(bool)]
    values["steps_to_success"] = float(solved["steps"].mean())
    values["path_m"] = float(solved["path_length"].astype(float).mean())
    distances = episodes.loc[~episodes["success"].astype(bool), "closest_approach"].astype(float).dropna()
    values["near_contact_failure"] = float((distances < NEAR).mean())
    return values | {name: float(part.built(episodes)) for name, part in registered_columns().items()}


def _mean_of_groups(episodes: pd.DataFrame) -> dict[str, float]:
    """Return the same measures as `_means`, averaged over difficulty groups.

    Each measure is an unweighted mean over the groups in which it is not NaN.
    """
    groups = pd.DataFrame([_means(group) for _, group in episodes.groupby("difficulty", sort=True)])
    return {str(name): float(value) for name, value in groups.mean().items()}


def registered_columns() -> Mapping[str, Part]:
    """Return the table columns that plugins add, by name.

    The `build` function of each computes the column's value from the episodes of a setting.
    """
    return parts("column")
