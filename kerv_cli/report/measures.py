"""Measure the episodes of a study's settings (docs/methods.md §7). Each result is a row of the study's table.

CSV and JSON files, the terminal, the page, the board and the verdict are views of these rows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from kerv_cli.base.registry import ColumnPart
from kerv_cli.engine.record import PHASES
from kerv_cli.report import statistics as stats
from kerv_cli.report.statistics import NO_ESTIMATE, Estimate, PairedCounts

Row = dict[str, Any]

# Columns by which episodes are grouped
OVERALL, PER_TASK = ["label"], ["task", "label"]
# Key of a field's metadata: the measure is the first column's sum over episodes, divided by the second's
RATIO = "ratio"


@dataclass(frozen=True)
class Measures:
    """The measured values of a group of episodes. A measure without data is NaN."""

    successes: int  # number of solved initial states. Repeats of an initial state are not counted.
    success: Estimate
    time_per_step_ms: float
    time_per_episode_ms: float
    phases: Mapping[str, float]  # milliseconds per control step, by phase of a decode. Keys begin with `ms.`.
    steps_to_success: float  # mean number of control steps of the episodes that succeeded
    path_m: float  # mean length of the end effector's path in the episodes that succeeded, metres
    jerk: float  # mean of the episodes' root mean square jerk of the end effector, m/s³
    near_contact_failure: float  # share of the failures in which the hand came near the object
    latency_p50_ms: float  # median time of a decode. `latency_p95_ms` and `latency_worst_ms` are of decodes, too.
    latency_p95_ms: float
    latency_worst_ms: float
    answer_ms: float = field(metadata={RATIO: ("seconds", "decodes")})  # mean time of a decode
    # mean time of an answer as the policy's server measures it
    server_ms: float = field(metadata={RATIO: ("server_seconds", "server_decodes")})
    AL: float = field(metadata={RATIO: ("committed", "verifications")})  # acceptance length, tokens per verification
    # accepted draft tokens per verification
    accepted_per_round: float = field(metadata={RATIO: ("accepted", "verifications")})
    # mean position of a draft's first rejected token
    AFEP: float = field(metadata={RATIO: ("first_rejected_sum", "first_rejected_count")})
    forwards_per_step: float = field(metadata={RATIO: ("forwards", "steps")})
    # share of decodes whose draft was executed without verification
    skip_rate: float = field(metadata={RATIO: ("skipped_decodes", "decodes")})
    # share of executed tokens that the target did not verify
    unverified_share: float = field(metadata={RATIO: ("unverified_tokens", "executed_tokens")})
    # share of decodes in which a prediction, not the target, filled in tokens
    compensation_rate: float = field(metadata={RATIO: ("compensated_decodes", "decodes")})
    # share of decodes in which retrieval drafted
    retrieval_share: float = field(metadata={RATIO: ("retrieval_decodes", "decodes")})
    # mean absolute difference between the executed actions and AR's, in normalised units
    deviation: float = field(metadata={RATIO: ("deviation_sum", "deviation_count")})
    # mean time that the world went on during a decode. `felt_latency_steps`: in control steps.
    felt_latency_ms: float = field(metadata={RATIO: ("delay_seconds", "delay_decodes")})
    felt_latency_steps: float = field(metadata={RATIO: ("delay_steps", "delay_decodes")})
    # share of control steps that repeated the last action, because no newer one had arrived
    held_share: float = field(metadata={RATIO: ("held_steps", "steps")})
    added: Mapping[str, float]  # values of the columns that plugins add, by name
    counts: PairedCounts  # outcomes of the pairs with the baseline
    mcnemar_p: float  # p-value of McNemar's exact test. NaN if there are no pairs.
    difference: Estimate  # success rate minus the baseline's success rate
    margin: float  # loss of success, as a share of episodes, below which a setting counts as non-inferior
    non_inferior: bool
    pairs_to_settle: float  # see `statistics.pairs_to_settle`
    same_run: bool  # whether the two episodes of every pair come from one run
    same_block: float  # share of pairs that were measured in one block (side by side in one process)
    steps: int
    decodes: int
    deviation_samples: int
    speedup: Estimate  # speed relative to the baseline, see `Speeds`
    episode_speedup: Estimate
    solved_speedup: Estimate

    @property
    def pairs(self) -> int:
        return int(sum(self.counts))


@dataclass(frozen=True)
class Result:
    """One row of a study's table: a setting, over all tasks or on one task.

    If episodes differ in the value of a text field, the field holds all values, joined by semicolons.
    """

    study: str
    label: str
    series: str  # name shared by all settings that differ only in the value of the study's axis (x axis of its chart)
    unstressed: str  # label of the same setting without stress
    method: str
    where: str  # the task of a row of one task. Empty for a row over all tasks.
    task: str
    tasks: int
    seeds: str  # seeds of the episodes, as `seeds_text` writes them
    episodes: int
    baseline: str  # label of the setting that this setting is compared with
    measures: Measures
    runs: int  # number of runs (commands) from which the intervals of speed were computed
    overrides: str
    settings: Mapping[str, Any]  # all settings as one dictionary with dotted keys, such as `threshold.r`
    observation: str
    hashes: Mapping[str, str]  # hashes of weights and data, by column (`target_sha256`)
    stress: str
    stress_level: int
    provenance: Mapping[str, str]  # machine, versions and the like, by column

    @property
    def is_baseline(self) -> bool:
        return self.label == self.baseline

    @property
    def is_compared(self) -> bool:
        return not self.is_baseline and self.measures.pairs > 0

    @property
    def speed(self) -> float:
        """Speed per episode relative to the baseline. 1 for the baseline, NaN if the speed was not measured."""
        return 1.0 if self.is_baseline else self.measures.episode_speedup.value

    def columns(self) -> Row:
        return columns_of({name: value for name, value in vars(self).items() if name != "where"})


def columns_of(values: Mapping[str, Any]) -> Row:
    """Flatten named values into the columns of one row.

    An `Estimate` NAME becomes NAME, NAME_low and NAME_high. `PairedCounts` become the column `pairs` (their number) and
    one column per outcome. A mapping becomes one column per key.
    """
    columns: Row = {}
    for name, value in values.items():
        if isinstance(value, Estimate):
            columns |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
        elif isinstance(value, PairedCounts):
            columns |= {"pairs": sum(value), **value._asdict()}
        elif isinstance(value, Measures):
            columns |= columns_of(vars(value))
        elif isinstance(value, Mapping):
            columns |= value
        else:
            columns[name] = value
    return columns


def csv_text(rows: Sequence[Row]) -> str:
    """Return rows as CSV text with six significant digits. Missing values are empty cells."""
    return pd.DataFrame(rows).to_csv(index=False, float_format="%.6g", lineterminator="\n")


def is_number(value: Any) -> bool:
    """Return whether a value is a real number other than NaN. Text, bool and None are not."""
    return isinstance(value, Real) and not isinstance(value, bool) and not math.isnan(value)


# Metres. In a failure nearer to the object than this, the hand came near it.
NEAR = 0.02
# Share of episodes. A setting that loses less success than this is non-inferior to the baseline.
MARGIN = 0.03

# Columns in which two episodes must agree before their times are compared
COMPARABLE = ("device", "device_name", "dtype", "threads")

# Measure -> (numerator, denominator), each a column summed over episodes. NaN if the denominator is 0.
_RATIOS = {one.name: one.metadata[RATIO] for one in fields(Measures) if RATIO in one.metadata}
_PHASES = {f"ms.{phase}": f"seconds.{phase}" for phase in PHASES}


def measure(
    episodes: pd.DataFrame,
    pairs: pd.DataFrame,
    by: Sequence[str] = OVERALL,
    speeds: Mapping[Hashable, Speeds] | None = None,
) -> dict[Hashable, Measures]:
    """Return every measure of each group of episodes.

    Args:
        episodes: One row per episode. Columns: those of rows.EPISODE_SCHEMA, `label`, `decode_seconds`, `run`, `block`,
            and those of `COMPARABLE`.
        pairs: Pairs of these episodes with the baselines', from `paired`.
        by: OVERALL or PER_TASK.
        speeds: Speedups by group. If None, `speedups` computes them from `pairs`.
    """
    speeds = speedups(pairs, by) if speeds is None else speeds
    by, outcomes, added = list(by), list(PairedCounts._fields), list(ColumnPart.every())
    counted = episodes.assign(episodes=1, successes=episodes["success"].astype(bool))
    counts = counted.groupby(by)[["episodes", "successes", "steps", "decodes", "deviation_count"]].sum()
    counts = counts.join(pairs.groupby(by)[outcomes].sum()).fillna(0).astype(int)
    numbers: dict[Any, Any] = counts.to_dict("index")
    means = _means(episodes, by).join(pairs.groupby(by)[["same_run", "same_block"]].mean())
    phases: dict[Any, Any] = means[list(_PHASES)].to_dict("index")
    of_plugins: dict[Any, Any] = means[added].to_dict("index")
    found: dict[Any, Any] = means.drop(columns=[*_PHASES, *added]).to_dict("index")
    measured: dict[Hashable, Measures] = {}
    for group, others in found.items():
        number = numbers[group]
        outcome = PairedCounts(*map(number.__getitem__, outcomes))
        difference = stats.paired_difference(outcome)
        measured[group] = Measures(
            successes=number["successes"],
            success=stats.wilson(number["successes"], number["episodes"]),
            phases=phases[group],
            added=of_plugins[group],
            same_run=others.pop("same_run") == 1,
            **others,
            counts=outcome,
            mcnemar_p=stats.mcnemar(outcome) if sum(outcome) else math.nan,
            difference=difference,
            margin=MARGIN,
            non_inferior=difference.low > -MARGIN,
            pairs_to_settle=stats.pairs_to_settle(outcome, MARGIN),
            steps=number["steps"],
            decodes=number["decodes"],
            deviation_samples=number["deviation_count"],
            **speeds.get(group, Speeds())._asdict(),
        )
    return measured


def paired(episodes: pd.DataFrame, baselines: Mapping[str, str]) -> pd.DataFrame:
    """Pair each setting's episodes with those of its baseline: same task, seed, initial state and `COMPARABLE` columns.

    Args:
        baselines: A setting's label -> its baseline's label. Settings without a baseline are left out.

    Returns:
        One row per pair, sorted by task and seed, with these columns:

        - `label`, `task`, `seed`, `decodes` (whether the setting runs a decoder), `same_run`, `same_block`
        - `time` (seconds per control step), `seconds` (of the whole episode), `block` and `success`, each once with the
          ending _baseline and once with _method
        - the outcomes of `PairedCounts`: 1 for the outcome of this pair, 0 for the others
    """
    keys = ["task", "seed"]
    columns = ["label", *keys, "run", "block", "success", "seconds", "initial_state", *COMPARABLE]
    other = episodes[columns].assign(time=episodes["seconds"] / episodes["steps"])
    method = other.assign(
        decodes=(episodes["forwards"] > 0) | (episodes["skipped_decodes"] > 0) | (episodes["server_decodes"] > 0),
        baseline=other["label"].map(baselines),
    )
    other = other.rename(columns={"label": "baseline"})
    both = method.merge(other, on=["baseline", *keys], suffixes=("_method", "_baseline"))
    agree = both["initial_state_method"] == both["initial_state_baseline"]
    for name in COMPARABLE:
        agree &= both[f"{name}_method"] == both[f"{name}_baseline"]
    both = both[agree].sort_values(keys, kind="stable").reset_index(drop=True)
    won, reference = both["success_method"].astype(bool), both["success_baseline"].astype(bool)
    return both.assign(
        same_run=both["run_method"] == both["run_baseline"],
        same_block=both["block_method"] == both["block_baseline"],
        both=(won & reference).astype(int),
        only_baseline=(~won & reference).astype(int),
        only_method=(won & ~reference).astype(int),
        neither=(~won & ~reference).astype(int),
    )


class Speeds(NamedTuple):
    """Speedups of a group of pairs: mean time of the baseline ÷ mean time of the method."""

    speedup: Estimate = NO_ESTIMATE  # per control step
    episode_speedup: Estimate = NO_ESTIMATE  # per episode
    # per episode, over the pairs that both solved. A failed episode runs to the horizon, so a single one can decide
    # the other two.
    solved_speedup: Estimate = NO_ESTIMATE


def speedups_of_runs(runs: Sequence[pd.DataFrame], by: Sequence[str], same_pairs: bool) -> dict[Hashable, Speeds]:
    """Return the speedups of each group of pairs, with intervals over the runs, or over episodes if there is one run.

    Args:
        runs: For each run, the pairs from `paired`.
        same_pairs: Whether all runs measured the same pairs.
    """
    combined, *others = [speedups(pairs, by) for pairs in runs]
    for group, speeds in combined.items() if others else ():
        several = zip(speeds, *[run.get(group, Speeds()) for run in others], strict=True)
        combined[group] = Speeds(*[stats.over_runs(estimates, same_pairs) for estimates in several])
    return combined


def speedups(pairs: pd.DataFrame, by: Sequence[str] = OVERALL, all_pairs: bool = False) -> dict[Hashable, Speeds]:
    """Return the speedups of each group of pairs.

    A group is left out if no pair is usable, or if its setting runs no decoder.

    Args:
        by: OVERALL or PER_TASK.
        all_pairs: Whether to use also pairs that were not measured in one block (side by side in one process).
    """
    timed = pairs if all_pairs else pairs[pairs["same_block"]]
    blocks = timed["block_method"].astype(str) + "|" + timed["block_baseline"].astype(str)
    tasks, clusters = pd.factorize(timed["task"])[0], pd.factorize(blocks)[0]
    decodes = timed["decodes"].to_numpy()
    solved = (timed["success_baseline"].astype(bool) & timed["success_method"].astype(bool)).to_numpy()

    numbers = ("time_baseline", "time_method", "seconds_baseline", "seconds_method")
    times = {name: timed[name].to_numpy(float) for name in numbers}

    def ratio(column: str, index: np.ndarray) -> Estimate:
        baseline, method = times[f"{column}_baseline"][index], times[f"{column}_method"][index]
        return stats.speedup(baseline, method, tasks[index], clusters[index])

    found = {}
    for group, members in timed.groupby(list(by)).indices.items():
        index = np.asarray(members)
        if decodes[index].any():
            solved_by_both = index[solved[index]]
            found[group] = Speeds(ratio("time", index), ratio("seconds", index), ratio("seconds", solved_by_both))
    return found


def _means(episodes: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    groups = episodes.groupby(by)
    per_step, solved = 1000.0 / episodes["steps"], episodes["success"].astype(bool)
    distances = episodes["closest_approach"].astype(float)
    each = {
        "time_per_step_ms": episodes["seconds"] * per_step,
        "time_per_episode_ms": 1000.0 * episodes["seconds"],
        "steps_to_success": episodes["steps"].where(solved),
        "path_m": episodes["path_length"].astype(float).where(solved),
        "jerk": episodes["jerk"].astype(float),
        "near_contact_failure": (distances < NEAR).astype(float).where(~solved & distances.notna()),
    }
    for name, column in _PHASES.items():
        each[name] = episodes[column] * per_step
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
    means[["felt_latency_ms", "answer_ms", "server_ms"]] *= 1000.0
    means["server_ms"] = means["server_ms"].where(means["server_ms"] > 0)  # 0: the servers do not say
    for name, part in ColumnPart.every().items():  # of plugins
        means[name] = [float(part.built(group)) for _, group in groups]
    return means
