"""Which setting to take: the Pareto front of speed and success, and the boldest setting of a study whose loss of
success stays below a bound with 95 % confidence (docs/methods.md §7)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MICRO
from kerv_cli.report.tables import is_number, rows_of

POINTS = 100.0
_STEP, _MOST_STEPS = 1.15, 60
"""Numbers of pairs are tried in steps of this factor."""
_BOLD: dict[str, tuple[int, str]] = {
    "threshold.r": (1, "the largest r"),
    "boundary.f_star": (-1, "the smallest F*"),
    "skip.max_skips": (1, "the most skips in a row"),
    "skip.s_min": (-1, "the smallest s_min"),
    "chunk": (1, "the longest chunk"),
}
"""Axis of a study -> the direction in which it saves more forwards, and the name of its boldest value."""


@dataclass(frozen=True)
class Choice:
    """The answer for a suite or a task. front: settings that no other one beats in both speed and success, the fastest
    first. chosen: the boldest setting whose loss of success is shown to be below the bound; empty if there is none.
    undecided: setting -> about how many pairs would show it; without the settings that no number of pairs would."""

    where: str
    pairs: int
    front: tuple[str, ...]
    chosen: str
    episode_speedup: float
    speedup: float  # per control step
    loss_at_most: float  # of the chosen one, points of success, 95 % confidence
    undecided: dict[str, float]


def choices(study: pd.DataFrame, per_task: pd.DataFrame, axis: str, loss: float) -> list[Choice]:
    """The suite's choice, then each task's.

    Args:
        study, per_task: the tables of `tables.study_table` and `tables.per_task_table`.
        axis: the study's; on an axis without an entry in `_BOLD` the fastest setting is the boldest.
        loss: bound on the loss of success, points.
    """
    suite = rows_of(study, MICRO)
    tasks = {str(task): rows_of(rows) for task, rows in per_task.groupby("task", sort=True)}
    return [_choice(where, rows, axis, loss) for where, rows in {"all tasks": suite, **tasks}.items()]


def _choice(where: str, rows: Sequence[dict[str, Any]], axis: str, loss: float) -> Choice:
    candidates = [row for row in rows if row["label"] != row["baseline"] and row["pairs"]]
    safe = [row for row in candidates if _loss_at_most(row) < loss]
    best = max(safe, key=lambda row: boldness(row, axis), default=None)
    undecided = {str(row["label"]): _needed(row, loss) for row in candidates if row not in safe}
    return Choice(
        where=where,
        pairs=max((int(row["pairs"]) for row in candidates), default=0),
        front=tuple(str(row["label"]) for row in pareto(rows)),
        chosen=str(best["label"]) if best else "",
        episode_speedup=float(best["episode_speedup"]) if best else math.nan,
        speedup=float(best["speedup"]) if best else math.nan,
        loss_at_most=_loss_at_most(best) if best else math.nan,
        undecided={label: pairs for label, pairs in undecided.items() if math.isfinite(pairs)},
    )


def _loss_at_most(row: Mapping[str, Any]) -> float:
    return -POINTS * float(row["difference_low"])


def _needed(row: Mapping[str, Any], loss: float) -> float:
    """About how many pairs would show that the loss is below the bound, if the rates of the four outcomes stayed as
    they are; infinite where the difference itself lies at the bound or below. Computed from the interval of the choice,
    not from the normal interval of `pairs_to_settle`, which is too narrow for few discordant pairs."""
    counts = [int(row[name]) for name in stats.PairedCounts._fields]
    pairs = sum(counts)
    if POINTS * (counts[2] - counts[1]) / pairs <= -loss:
        return math.inf
    for steps in range(1, _MOST_STEPS):
        more = stats.PairedCounts(*(round(count * _STEP**steps) for count in counts))
        if -POINTS * stats.paired_difference(more).low < loss:
            return float(sum(more))
    return math.inf


def boldness(row: Mapping[str, Any], axis: str) -> tuple[float, float]:
    """What a choice maximises: the position on the axis, where `_BOLD` gives it a direction, then the speed per
    episode."""
    value = row.get(axis)
    position = math.inf
    if axis in _BOLD:
        numeric = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        position = _BOLD[axis][0] * float(value) if numeric else -math.inf  # type: ignore[arg-type]
    speed = float(row["episode_speedup"]) if is_number(row["episode_speedup"]) else -math.inf
    return (position, speed)


def pareto(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows that no other one beats in speed per episode and success at once, the fastest first. The baseline's speed
    is 1."""

    def point(row: Mapping[str, Any]) -> tuple[float, float]:
        return (1.0 if row["label"] == row["baseline"] else float(row["episode_speedup"]), float(row["success"]))

    timed = [row for row in rows if row["label"] == row["baseline"] or is_number(row["episode_speedup"])]
    front = [row for row in timed if not any(_beats(point(other), point(row)) for other in timed)]
    return sorted(front, key=point, reverse=True)


def _beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return a != b and a[0] >= b[0] and a[1] >= b[1]


def boldest(axis: str) -> str:
    """Name of the choice on this axis, e.g. `the largest r`."""
    return _BOLD.get(axis, (0, "the fastest setting"))[1]


def sentence(choice: Choice, axis: str, loss: float, baseline: str) -> str:
    """The choice for the whole suite in words."""
    bound = f"loses less than {loss:g} points of success against {baseline}, with 95 % confidence"
    if choice.chosen:
        speeds = f"{choice.episode_speedup:.2f} times as fast as {baseline} per episode, {choice.speedup:.2f} per step"
        speed = f", {speeds}" if is_number(choice.episode_speedup) else ""
        return f"{boldest(axis)} that {bound}: {choice.chosen}{speed} ({choice.pairs} pairs)"
    return f"{choice.pairs} pairs do not yet show a setting that {bound}; {_missing(choice)}"


def short(choice: Choice) -> str:
    """The choice for one task in a few words."""
    if choice.chosen:
        return f"{choice.where}: {choice.chosen}"
    return f"{choice.where}: undecided after {choice.pairs} pairs; {_missing(choice)}"


def _missing(choice: Choice) -> str:
    if not choice.undecided:
        return "more would not show one"
    label, pairs = min(choice.undecided.items(), key=lambda item: item[1])
    more = max(1, math.ceil(pairs - choice.pairs))
    return f"about {more} more would show it for {label} at the present rates"


def choices_frame(answers: Sequence[Choice]) -> pd.DataFrame:
    """The choices as a table, for CSV and JSON."""
    rows = []
    for choice in answers:
        row = asdict(choice)
        row["front"] = ";".join(choice.front)
        row["undecided"] = ";".join(f"{label}: {pairs:.0f} pairs" for label, pairs in choice.undecided.items())
        rows.append(row)
    return pd.DataFrame(rows)
