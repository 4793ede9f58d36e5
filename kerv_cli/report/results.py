"""The results of one setting of a study. Each is a row of the study's table.

CSV and JSON files, the terminal, the page, the board and the verdict all show these rows.
docs/methods.md §7 explains the measures.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import pandas as pd

from kerv_cli.report.statistics import Estimate, PairedCounts

Row = dict[str, Any]
"""One row of a table as it is written: column name to value."""

MICRO = "micro over tasks"
MACRO = "macro over difficulty groups"
ONE_TASK = "one task"
RATIO = "ratio"
"""Key of a measure's metadata: the columns of the episodes whose sums are its numerator and its denominator."""


@dataclass(frozen=True)
class Measures:
    """What was measured of a group of episodes. A measure without data is NaN.

    Attributes:
        successes: Number of solved worlds. Repeats measure the same world again and are not counted.
        success: Success rate.
        time_per_step_ms: Inference time per control step.
        time_per_episode_ms: Inference time per episode.
        phases: Time per control step in milliseconds, by phase of a decode. Keys begin with `ms.`.
        steps_to_success: Mean number of control steps of the episodes that succeeded.
        path_m: Mean length of the end effector's path in the episodes that succeeded, metres.
        jerk: Mean of the episodes' root mean square jerk of the end effector, m/s³.
        near_contact_failure: Share of the failures in which the hand came near the object.
        latency_p50_ms: Median time of a decode.
        latency_p95_ms: 95th percentile of the time of a decode.
        latency_worst_ms: Time of the slowest decode.
        AL: Acceptance length, tokens per verification.
        accepted_per_round: Accepted draft tokens per verification.
        AFEP: Mean position of a draft's first rejected token.
        forwards_per_step: Target forwards per control step.
        skip_rate: Share of decodes whose draft was executed without verification.
        unverified_share: Share of executed tokens that the target did not verify.
        compensation_rate: Share of decodes in which a prediction, not the target, filled in tokens.
        retrieval_share: Share of decodes in which retrieval drafted.
        deviation: Mean absolute difference between the executed actions and AR's, in normalised units.
        felt_latency_ms: Mean time that the world went on during a decode.
        felt_latency_steps: Mean number of control steps that the world went on during a decode.
        held_share: Share of control steps that repeated the last action, because no newer one had arrived.
        added: Values of the columns that plugins add, by name.
        counts: Outcomes of the pairs with the baseline.
        mcnemar_p: p-value of McNemar's exact test. NaN if there are no pairs.
        difference: Success rate minus the baseline's.
        margin: Loss of success below which a setting counts as non-inferior to the baseline.
        non_inferior: Whether the loss of success is shown to be smaller than `margin`.
        pairs_to_settle: Number of pairs that would show a loss below `margin`, see `statistics.pairs_to_settle`.
        same_run: Whether the two episodes of every pair come from one run.
        same_block: Share of pairs that were measured in one block (side by side in one process).
        steps: Number of control steps.
        decodes: Number of decodes.
        deviation_samples: Number of decodes whose deviation was measured.
        speedup: Speed per control step against the baseline, see `measures.speedups`.
        episode_speedup: Speed per episode.
        solved_speedup: Speed per episode, over the pairs that both solved.
    """

    successes: int
    success: Estimate
    time_per_step_ms: float
    time_per_episode_ms: float
    phases: Mapping[str, float]
    steps_to_success: float
    path_m: float
    jerk: float
    near_contact_failure: float
    latency_p50_ms: float
    latency_p95_ms: float
    latency_worst_ms: float
    AL: float = field(metadata={RATIO: ("committed", "verifications")})
    accepted_per_round: float = field(metadata={RATIO: ("accepted", "verifications")})
    AFEP: float = field(metadata={RATIO: ("first_rejected_sum", "first_rejected_count")})
    forwards_per_step: float = field(metadata={RATIO: ("forwards", "steps")})
    skip_rate: float = field(metadata={RATIO: ("skipped_decodes", "decodes")})
    unverified_share: float = field(metadata={RATIO: ("unverified_tokens", "executed_tokens")})
    compensation_rate: float = field(metadata={RATIO: ("compensated_decodes", "decodes")})
    retrieval_share: float = field(metadata={RATIO: ("retrieval_decodes", "decodes")})
    deviation: float = field(metadata={RATIO: ("deviation_sum", "deviation_count")})
    felt_latency_ms: float = field(metadata={RATIO: ("delay_seconds", "delay_decodes")})
    felt_latency_steps: float = field(metadata={RATIO: ("delay_steps", "delay_decodes")})
    held_share: float = field(metadata={RATIO: ("held_steps", "steps")})
    added: Mapping[str, float]
    counts: PairedCounts
    mcnemar_p: float
    difference: Estimate
    margin: float
    non_inferior: bool
    pairs_to_settle: float
    same_run: bool
    same_block: float
    steps: int
    decodes: int
    deviation_samples: int
    speedup: Estimate
    episode_speedup: Estimate
    solved_speedup: Estimate

    @property
    def pairs(self) -> int:
        """Number of pairs with the baseline."""
        return int(sum(self.counts))

    @property
    def is_timed(self) -> bool:
        """Whether all episodes were timed."""
        return is_number(self.time_per_step_ms)


@dataclass(frozen=True)
class Result:
    """One row of a study's table: a setting, over all tasks or on one task.

    If episodes differ in the value of a text field, semicolons join the values.

    Attributes:
        study: Name of the study.
        averaging: MICRO if all episodes are pooled, MACRO if difficulty groups are averaged, or ONE_TASK.
        label: Label of the setting.
        series: Name shared by all settings that differ only in the value on the study's axis.
        unstressed: Label of the same setting without stress.
        method: The setting's decoding method.
        task: Names of the tasks.
        tasks: Number of tasks.
        difficulty: Difficulty groups of the tasks.
        seeds: Seeds of the episodes, as `seeds_text` writes them.
        repeats: How often every episode was measured.
        episodes: Number of episodes.
        baseline: Label of the setting that this one is compared with.
        measures: Measured values.
        runs: Number of runs (commands) from which the intervals of speed were computed.
        overrides: Overrides of the setting, as typed.
        settings: The setting, with dotted keys.
        observation: What the target observes.
        hashes: Hashes of weights and data, by column (`target_sha256`).
        stress: Kind of stress, or `none`.
        stress_level: Level of stress.
        provenance: Machine, versions and the like, by column.
        matched_success_speed: See `verdict.with_matched_speed`.
    """

    study: str
    averaging: str
    label: str
    series: str
    unstressed: str
    method: str
    task: str
    tasks: int
    difficulty: str
    seeds: str
    repeats: int
    episodes: int
    baseline: str
    measures: Measures
    runs: int
    overrides: str
    settings: Mapping[str, Any]
    observation: str
    hashes: Mapping[str, str]
    stress: str
    stress_level: int
    provenance: Mapping[str, str]
    matched_success_speed: float = math.nan

    @property
    def where(self) -> str:
        """The task if the row is of one task, else the way of averaging."""
        return self.averaging if self.averaging in (MICRO, MACRO) else self.task

    @property
    def is_baseline(self) -> bool:
        """Whether the row belongs to the baseline itself, which is not compared with anything."""
        return self.label == self.baseline

    @property
    def is_compared(self) -> bool:
        """Whether there are pairs to compare the setting with its baseline. Never so for the baseline itself."""
        return not self.is_baseline and self.measures.pairs > 0

    @property
    def speed(self) -> float:
        """Speed per episode against the baseline. 1 for the baseline itself, NaN if it was not measured."""
        return 1.0 if self.is_baseline else self.measures.episode_speedup.value


def columns_of(values: Mapping[str, Any]) -> Row:
    """Return the fields of a row as the columns of a table.

    An `Estimate` NAME becomes three columns: NAME, and NAME_low and NAME_high for the interval. `PairedCounts` become
    the column `pairs` (number of pairs) and one column per outcome. A mapping becomes one column per key.

    Args:
        values: Fields by name, such as `vars(result)`.
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


def frame_of(results: Iterable[Result]) -> pd.DataFrame:
    """Return rows as a data frame. A missing value is NaN."""
    return pd.DataFrame(map(columns_of, map(vars, results)))


def averaged(results: Iterable[Result], averaging: str = MICRO) -> list[Result]:
    """Return the rows that pool all episodes (MICRO), or the rows that average over difficulty groups (MACRO)."""
    return [row for row in results if row.averaging == averaging]


def csv_text(table: pd.DataFrame) -> str:
    """Return a data frame as CSV text with six significant digits. Missing values are empty cells."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


def is_number(value: Any) -> bool:
    """Return whether a value is a real number other than NaN. Text, bool and None are not."""
    return isinstance(value, Real) and not isinstance(value, bool) and not math.isnan(value)
