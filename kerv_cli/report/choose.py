"""Which setting to take: the Pareto front of speed and success, and the fastest setting of a study whose loss of
success is shown to be below a bound (docs/methods.md §7)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import MICRO
from kerv_cli.report.tables import is_number, rows_of

POINTS = 100.0
SPEED = "episode_speedup"


@dataclass(frozen=True)
class Choice:
    """The answer for a suite or a task. front: settings that no other one beats in both speed and success, the fastest
    first. chosen: the fastest setting whose loss of success is shown to be below the bound; empty if there is none.
    speedup, loss_at_most: of the chosen one, points of success at 95 % confidence. candidate: the fastest that more
    pairs would show at the present rates, empty if there is none, and about how many pairs, all in all."""

    where: str
    pairs: int
    front: tuple[str, ...]
    chosen: str
    speedup: stats.Estimate
    loss_at_most: float
    candidate: str
    candidate_pairs: float


def choices(study: pd.DataFrame, per_task: pd.DataFrame | None, loss: float) -> list[Choice]:
    """The suite's choice, then each task's.

    Args:
        study, per_task: the tables of `tables.study_table` and `tables.per_task_table`; None: the suite alone.
        loss: bound on the loss of success, points.
    """
    suite = rows_of(study, MICRO)
    groups = () if per_task is None else per_task.groupby("task", sort=True)
    tasks = {str(task): rows_of(rows) for task, rows in groups}
    return [_choice(where, rows, loss) for where, rows in {"all tasks": suite, **tasks}.items()]


def _choice(where: str, rows: Sequence[dict[str, Any]], loss: float) -> Choice:
    order = safest_first(rows)
    safe = list(itertools.takewhile(lambda row: _loss_at_most(row) < loss, order))
    best = _fastest(safe)
    needed = itertools.accumulate((_needed(row, loss) for row in order), max)  # whatever is safer has to be shown too
    reached = {str(row["label"]): pairs for row, pairs in zip(order, needed, strict=True) if math.isfinite(pairs)}
    candidate = _fastest([row for row in order if str(row["label"]) in reached])
    label = str(candidate["label"]) if candidate and not best else ""
    return Choice(
        where=where,
        pairs=max((int(row["pairs"]) for row in order), default=0),
        front=tuple(str(row["label"]) for row in pareto(rows)),
        chosen=str(best["label"]) if best else "",
        speedup=stats.Estimate(*(float(best[f"{SPEED}{end}"]) for end in ("", "_low", "_high")))
        if best
        else stats.NO_ESTIMATE,
        loss_at_most=_loss_at_most(best) if best else math.nan,
        candidate=label,
        candidate_pairs=reached.get(label, math.nan),
    )


def safest_first(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The settings in the order in which they are tested, each only where all before it passed (fixed-sequence
    testing): however many there are, the error is that of one test. What executes less unverified comes first, then
    what asks the target more often per step, then the study's order; none of this looks at success. A setting that is
    not faster than the baseline is no answer and is left out, unless nobody timed it."""
    paired = [row for row in rows if row["label"] != row["baseline"] and row["pairs"]]
    faster = [row for row in paired if not is_number(row[SPEED]) or row[SPEED] > 1]
    return sorted(faster, key=lambda row: (_unverified(row), -row["forwards_per_step"]))


def _unverified(row: Mapping[str, Any]) -> float:
    """Share in whole per cent; all where nothing decodes."""
    return round(float(row["unverified_share"]), 2) if is_number(row["unverified_share"]) else 1.0


def _fastest(rows: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The fastest of settings in the order of their tests; the last where none is timed."""
    return max(reversed(rows), key=lambda row: row[SPEED] if is_number(row[SPEED]) else -math.inf, default=None)


def _loss_at_most(row: Mapping[str, Any]) -> float:
    return -POINTS * float(row["difference_low"])


def _needed(row: Mapping[str, Any], loss: float) -> float:
    counts = stats.PairedCounts(*(int(row[name]) for name in stats.PairedCounts._fields))
    return stats.pairs_to_settle(counts, loss / POINTS)


def pareto(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows that no other one beats in speed per episode and success at once, the fastest first. The baseline's is 1."""

    def point(row: Mapping[str, Any]) -> tuple[float, float]:
        return (1.0 if row["label"] == row["baseline"] else float(row[SPEED]), float(row["success"]))

    timed = [row for row in rows if row["label"] == row["baseline"] or is_number(row[SPEED])]
    front = [row for row in timed if not any(_beats(point(other), point(row)) for other in timed)]
    return sorted(front, key=point, reverse=True)


def _beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return a != b and a[0] >= b[0] and a[1] >= b[1]


def sentence(choice: Choice, loss: float, baseline: str) -> str:
    """The choice for the whole suite in words."""
    bound = f"loses less than {loss:g} points of success against {baseline}, with 95 % confidence"
    if choice.chosen:
        value, low, high = choice.speedup
        times = f"{value:.2f} ({low:.2f}–{high:.2f})" if is_number(low) else f"{value:.2f}"
        speed = f", per episode {times} times as fast as {baseline} on this machine" if is_number(value) else ""
        return f"the fastest setting that {bound}: {choice.chosen}{speed} ({choice.pairs} pairs)"
    return f"{choice.pairs} pairs do not yet show a setting that is faster and {bound}; {_missing(choice)}"


def short(choice: Choice) -> str:
    """The choice for one task in a few words."""
    if choice.chosen:
        return f"{choice.where}: {choice.chosen}"
    return f"{choice.where}: undecided after {choice.pairs} pairs; {_missing(choice)}"


def _missing(choice: Choice) -> str:
    if not choice.candidate:
        return "more would not show one"
    more = max(1, math.ceil(choice.candidate_pairs - choice.pairs))
    return f"about {more} more would show it for {choice.candidate} at the present rates"


def choices_frame(answers: Sequence[Choice]) -> pd.DataFrame:
    """The choices as a table, for CSV and JSON."""
    rows = []
    for choice in answers:
        speed = dict(zip((SPEED, f"{SPEED}_low", f"{SPEED}_high"), choice.speedup, strict=True))
        plain = {name: value for name, value in asdict(choice).items() if name != "speedup"}
        rows.append({**plain, "front": ";".join(choice.front), **speed})
    return pd.DataFrame(rows)
