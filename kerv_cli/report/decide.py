"""Decide which setting to take (`kerv report --choose`): the fastest that is shown to lose little success.

It tests the settings of a finished study in a fixed order, the safest first, and ends at the first that fails
(fixed-sequence testing). So all tests together have the error rate of one test (docs/methods.md §7).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import pandas as pd

from kerv_cli.report import statistics as stats
from kerv_cli.report import verdict
from kerv_cli.report.matched import SOLVED, passing, safety
from kerv_cli.report.measures import MICRO, Row
from kerv_cli.report.tables import is_baseline, is_number, rows_of
from kerv_cli.report.verdict import Choice

POINTS = 100.0
SPEED = "episode_speedup"


def verdict_of(table: pd.DataFrame, loss: float) -> tuple[str, bool]:
    """Return a study's answer as a sentence for the report.

    Args:
        table: The study's table, with one row per setting and averaging.
        loss: Largest acceptable loss of success against the baseline, in points (percentage points).

    Returns:
        The sentence, and whether a setting is shown both to be faster and to lose less than `loss`.
    """
    rows, is_shown = rows_of(table, MICRO), False
    if not any(row["pairs"] and not is_baseline(row) for row in rows):
        text = "success: " + ", ".join(f"{row['label']} {POINTS * row['success']:.1f} %" for row in rows)
    elif table["baseline"].nunique() > 1:
        text = verdict.under_conditions(rows, next(row["method"] for row in rows if is_baseline(row)))
    else:
        choice = _choice("all tasks", rows, loss)
        text, is_shown = verdict.sentence(choice, loss, str(rows[0]["baseline"])), choice.is_shown
    return f"{text}.", is_shown


def choices(table: pd.DataFrame, per_task: pd.DataFrame, loss: float) -> list[Choice]:
    """Return which setting to take for all tasks together, followed by which to take for each task.

    Args:
        table: The study's table, pooled over tasks.
        per_task: The same table with rows per task.
        loss: Largest acceptable loss of success against the baseline, in points.
    """
    tasks = {str(task): rows_of(rows) for task, rows in per_task.groupby("task", sort=True)}
    return [_choice(where, rows, loss) for where, rows in {"all tasks": rows_of(table, MICRO), **tasks}.items()]


def _choice(where: str, rows: Sequence[Row], loss: float) -> Choice:
    """Choose a setting for one task or for all tasks.

    Args:
        where: The task's name, or `all tasks`.
        rows: The table's rows for that task or for all tasks, one per setting, the baseline included.
        loss: Largest acceptable loss of success against the baseline, in points.
    """
    success = next((float(row["success"]) for row in rows if is_baseline(row)), math.nan)
    order = [] if success < SOLVED else safest_first(rows)
    best = _fastest(passing(order, loss / POINTS))
    # a setting is tested only after all safer ones have passed, so it needs the most pairs of all of these
    counts = (stats.PairedCounts(*(int(row[name]) for name in stats.PairedCounts._fields)) for row in order)
    pairs = itertools.accumulate((stats.pairs_to_settle(one, loss / POINTS) for one in counts), max)
    reached = {str(row["label"]): least for row, least in zip(order, pairs, strict=True) if math.isfinite(least)}
    candidate = None if best else _fastest([row for row in order if str(row["label"]) in reached])
    label = str(candidate["label"]) if candidate else ""
    return Choice(
        where,
        pairs=max((int(row["pairs"]) for row in rows if not is_baseline(row)), default=0),
        baseline_success=success,
        front=() if success < SOLVED else tuple(str(row["label"]) for row in pareto(rows)),
        chosen=str(best["label"]) if best else "",
        loss_at_most=-POINTS * float(best["difference_low"]) if best else math.nan,
        candidate=label,
        candidate_pairs=reached.get(label, math.nan),
        tested=len(order),
        runs=int(best["runs"]) if best else 0,
        **{f"{SPEED}{end}": float(best[f"{SPEED}{end}"]) if best else math.nan for end in ("", "_low", "_high")},
    )


def safest_first(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the settings to test, the safest first. Success does not influence the order.

    Safe means: few unverified tokens, then many forwards per control step (`safety`). Settings that are equally safe
    keep the study's order. The baseline, settings without pairs, and settings that were timed and were not faster are
    left out.
    """
    compared = [row for row in rows if not is_baseline(row) and row["pairs"]]
    return sorted((row for row in compared if not is_number(row[SPEED]) or row[SPEED] > 1), key=safety)


def _fastest(rows: Sequence[Row]) -> Row | None:
    """Return the row of the fastest of the tested settings, or None if there are none.

    A setting whose interval shows that it is faster than the baseline is preferred to any other. If no setting has a
    measured speed, return the one that was tested last.
    """
    return max(
        reversed(rows),
        key=lambda row: (row[f"{SPEED}_low"] > 1, row[SPEED]) if is_number(row[SPEED]) else (False, -math.inf),
        default=None,
    )


def pareto(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that no other row beats in both speed per episode and success, the fastest first.

    The baseline has speed 1. Rows without a measured speed are left out.
    """

    def point(row: Row) -> tuple[float, float]:
        return (1.0 if is_baseline(row) else float(row[SPEED]), float(row["success"]))

    timed = [row for row in rows if is_baseline(row) or is_number(row[SPEED])]
    front: list[Row] = []
    for row in sorted(timed, key=point, reverse=True):
        if not front or row["success"] > front[-1]["success"] or point(row) == point(front[-1]):
            front.append(row)
    return front
