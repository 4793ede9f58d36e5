"""Matched-success speed: how fast a method is at its fastest setting that keeps success (docs/methods.md §7).

The measure is from WA-SpecDec, arXiv 2608.08725.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

from kerv_cli.report.measures import MARGIN, Row

SOLVED = 0.20
"""Smallest success rate at which the baseline counts as solving its tasks."""


def safety(row: Row) -> tuple[float, float]:
    """Return the key that sorts settings from the safest on. It does not depend on success.

    The setting with the smallest unverified share comes first: the share of executed actions that the target has not
    verified, rounded to whole per cent. Settings that decode nothing come last. Of settings with equal shares, the one
    with the most target forwards per control step comes first.
    """
    unverified = float(row["unverified_share"])
    return (1.0 if math.isnan(unverified) else round(unverified, 2), -row["forwards_per_step"])


def passing(rows: Iterable[Row], loss: float) -> list[Row]:
    """Return the rows of settings that are shown to lose less than `loss`: those before the first that is not.

    By fixed-sequence testing, all tests together have the error rate of one test.

    Args:
        rows: Rows of a table, in the order of the tests.
        loss: Largest acceptable loss of success, as a share of episodes.
    """
    return list(itertools.takewhile(lambda row: row["difference_low"] > -loss, rows))


def with_matched_speed(rows: Sequence[Row]) -> list[Row]:
    """Add the column `matched_success_speed`: one figure per method and baseline, in each of the method's rows.

    It is the largest `episode_speedup` of the settings that pass the test with a margin of 3 points. It is missing if
    no setting passes, or if the settings that pass were not timed. It is also missing for the baseline itself, and if
    the baseline does not solve the tasks.

    Args:
        rows: One row per setting, with one way of averaging.
    """
    solved = {row["label"] for row in rows if row["label"] == row["baseline"] and row["success"] >= SOLVED}
    compared = [row for row in rows if row["baseline"] in solved - {row["label"]} and row["pairs"]]
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in sorted(compared, key=safety):
        groups.setdefault((row["method"], row["baseline"]), []).append(row)
    fastest = {
        label: max(
            (row["episode_speedup"] for row in passing(group, MARGIN) if row["episode_speedup"] > 0), default=math.nan
        )
        for label, group in groups.items()
    }
    return [
        row
        | {
            "matched_success_speed": math.nan
            if row["label"] == row["baseline"]
            else fastest.get((row["method"], row["baseline"]), math.nan)
        }
        for row in rows
    ]
