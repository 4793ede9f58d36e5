"""Decide which setting to take (`kerv report --choose`) and which settings a sweep may stop (`until=decided`).

Both ask whether a setting loses less success against the baseline than a given bound (docs/methods.md §7).

`--choose` works on a finished study. It tests the settings in a fixed order, the safest first, and ends at the first
that fails (fixed-sequence testing). So all tests together have the error rate of one test.

`until=decided` looks at the results after every block of seeds. The intervals use Pocock's constant boundary
(Biometrika 64, 1977): if a setting's true loss is exactly the bound, the probability that any of the planned looks
decides it is at most 5 %.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import NormalDist

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import read_json, write_json
from kerv_cli.lab.plan import Episode
from kerv_cli.lab.store import StudyStore
from kerv_cli.lab.study import InterimAnalysis
from kerv_cli.report import statistics as stats
from kerv_cli.report import verdict
from kerv_cli.report.matched import SOLVED, passing, safety
from kerv_cli.report.measures import MICRO, Row, paired
from kerv_cli.report.tables import StudyData, is_baseline, is_number, load_study, rows_of
from kerv_cli.report.verdict import LARGER, OPEN, SMALLER, Choice, Decision

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
        rows: The table's rows there, one per setting, the baseline included.
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
    """Return the settings in the order in which `--choose` tests them. The order does not depend on success.

    Settings that are equally safe keep the study's order. The baseline, settings without pairs, and settings that were
    timed and were not faster are left out.
    """
    compared = [row for row in rows if not is_baseline(row) and row["pairs"]]
    return sorted((row for row in compared if not is_number(row[SPEED]) or row[SPEED] > 1), key=safety)


def _fastest(rows: Sequence[Row]) -> Row | None:
    """Return the fastest of the tested settings, or None if there are none.

    Settings whose interval shows that they are faster than the baseline come before all others. If no setting has a
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


_CONSTANTS = (1.960, 2.178, 2.289, 2.361, 2.413, 2.453, 2.485, 2.512, 2.535, 2.555, 2.572, 2.588, 2.602, 2.614, 2.626,
              2.637, 2.646, 2.655, 2.663, 2.671)  # fmt: skip
"""Pocock's critical values of |z| for 1, 2, … 20 equally spaced looks, at 5 % two-sided in all (Jennison and Turnbull,
Group Sequential Methods, table 2.1).
"""


def confidence_of_a_look(looks: int) -> float:
    """Return the confidence level of the interval at each look (interim analysis), for 95 % over all looks together.

    Args:
        looks: Number of planned looks.

    Raises:
        UsageError: There are more looks than Pocock's table covers.
    """
    if not 1 <= looks <= len(_CONSTANTS):
        raise UsageError(f"until=decided with {looks} looks: at most {len(_CONSTANTS)}; set study.block higher")
    return float(1 - 2 * NormalDist().cdf(-_CONSTANTS[looks - 1]))


def decision_of(label: str, counts: stats.PairedCounts, margin: float, look: int, looks: int) -> Decision:
    """Decide whether a setting's loss of success is smaller or larger than a bound, or still open.

    Args:
        label: The setting's label.
        counts: Outcomes of its pairs with the baseline so far.
        margin: The bound, as a share of episodes (0.03: three points).
        look: Number of this look, from 1.
        looks: Number of planned looks.
    """
    difference = stats.paired_difference(counts, confidence_of_a_look(looks))
    answer = SMALLER if difference.low > -margin else LARGER if difference.high < -margin else OPEN
    return Decision(label, answer, int(sum(counts)), look, *difference)


def decisions(data: StudyData, labels: Sequence[str], margin: float, look: int, looks: int) -> list[Decision]:
    """Decide for each setting from all its pairs with the baseline.

    Args:
        data: The study with the episodes that have run.
        labels: Settings to decide.
        margin: Largest acceptable loss of success, as a share of episodes.
        look: Number of this look, from 1.
        looks: Number of planned looks.
    """
    pairs = paired(data.episodes, dict.fromkeys(labels, data.study.baseline))
    sums = pairs.groupby("label")[list(stats.PairedCounts._fields)].sum().reindex(list(labels), fill_value=0)
    counts = (stats.PairedCounts(*row) for row in sums.to_numpy().tolist())
    return [decision_of(label, one, margin, look, looks) for label, one in zip(labels, counts, strict=True)]


def judge(loss: float, tell: Callable[[str], None]) -> InterimAnalysis:
    """Return the function that a sweep calls after every block of seeds to learn which settings are still open.

    Args:
        loss: Largest acceptable loss of success against the baseline, in points.
        tell: Receives one line of progress per look.

    Returns:
        The `analysis` argument of `study.run`. It writes decided.json and returns the labels to continue with.
    """
    latest: dict[str, Decision] = {}

    def ask(store: StudyStore, wanted: Sequence[Episode], labels: Sequence[str], look: int, looks: int) -> list[str]:
        answers = decisions(load_study(store, wanted), labels, loss / POINTS, look, looks)
        tell(f"look {look} of {looks}: {verdict.progress_line(answers)}")
        latest.update({answer.label: answer for answer in answers})
        write_decisions(store.root, latest, loss, looks)
        return [answer.label for answer in answers if answer.verdict == OPEN]

    return ask


def write_decisions(folder: Path, answers: Mapping[str, Decision], loss: float, looks: int) -> None:
    """Write decided.json into the study's folder, with the latest decision on every setting.

    Args:
        folder: The study's folder.
        answers: Label to decision.
        loss: Largest acceptable loss of success, in points.
        looks: Number of planned looks.

    Raises:
        StorageError: The disk is full or read-only.
    """
    rows = [{k: None if v != v else v for k, v in asdict(answer).items()} for answer in answers.values()]
    head = {"loss_points": loss, "looks": looks, "confidence_of_a_look": confidence_of_a_look(looks)}
    write_json(folder / "decided.json", {**head, "settings": rows})


def read_decisions(folder: Path) -> list[Row]:
    """Return the latest decision on every setting, as JSON objects. The list is empty without `until=decided`.

    Args:
        folder: The study's folder.

    Raises:
        CheckpointError: decided.json is damaged.
    """
    path = folder / "decided.json"
    return list(read_json(path)["settings"]) if path.is_file() else []
