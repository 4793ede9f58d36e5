"""Which setting to take (`kerv report --choose`), and which settings a sweep stops (`until=decided`).

Both judge by a bound on the loss of success (docs/methods.md §7). A choice tests the settings of a finished study in a
fixed order, the safest first, up to the first that fails. Its error is that of one test. A sweep looks after every
block of seeds, with Pocock's constant boundary (Biometrika 64, 1977). A setting exactly at the bound is misjudged at
any of the planned looks with a probability of at most 5 %.
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
from kerv_cli.report.measures import MICRO, Row, pair_counts, paired
from kerv_cli.report.tables import StudyData, is_baseline, is_number, load_study, rows_of
from kerv_cli.report.verdict import LARGER, OPEN, SMALLER, Choice, Decision

POINTS = 100.0
SPEED = "episode_speedup"


def verdict_of(table: pd.DataFrame, loss: float) -> tuple[str, bool]:
    """Return a study's answer in one sentence, and whether a setting is shown to be faster at that loss in points."""
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
    """Return the choice for all tasks, then the choice for each task.

    Args:
        table: A study's table.
        per_task: A study's table by task.
        loss: Bound on the loss of success, points.
    """
    tasks = {str(task): rows_of(rows) for task, rows in per_task.groupby("task", sort=True)}
    return [_choice(where, rows, loss) for where, rows in {"all tasks": rows_of(table, MICRO), **tasks}.items()]


def _choice(where: str, rows: Sequence[Row], loss: float) -> Choice:
    success = next((float(row["success"]) for row in rows if is_baseline(row)), math.nan)
    order = [] if success < verdict.SOLVED else safest_first(rows)
    best = _fastest(list(itertools.takewhile(lambda row: -POINTS * row["difference_low"] < loss, order)))
    # a setting is shown only after all safer ones
    counts = (stats.PairedCounts(*(int(row[name]) for name in stats.PairedCounts._fields)) for row in order)
    pairs = itertools.accumulate((stats.pairs_to_settle(one, loss / POINTS) for one in counts), max)
    reached = {str(row["label"]): least for row, least in zip(order, pairs, strict=True) if math.isfinite(least)}
    candidate = None if best else _fastest([row for row in order if str(row["label"]) in reached])
    label = str(candidate["label"]) if candidate else ""
    return Choice(
        where,
        pairs=max((int(row["pairs"]) for row in rows if not is_baseline(row)), default=0),
        baseline_success=success,
        front=tuple(str(row["label"]) for row in pareto(rows)),
        chosen=str(best["label"]) if best else "",
        loss_at_most=-POINTS * float(best["difference_low"]) if best else math.nan,
        candidate=label,
        candidate_pairs=reached.get(label, math.nan),
        tested=len(order),
        **{f"{SPEED}{end}": float(best[f"{SPEED}{end}"]) if best else math.nan for end in ("", "_low", "_high")},
    )


def safest_first(rows: Sequence[Row]) -> list[Row]:
    """Return the settings in the order in which they are tested; none of it looks at success.

    First what executes less unverified (in whole per cent, and settings that decode nothing last), then what asks the
    target more often per step, then the study's order. Settings that were timed and not faster are left out.
    """

    def order(row: Row) -> tuple[float, float]:
        unverified = row["unverified_share"]
        return (round(float(unverified), 2) if is_number(unverified) else 1.0, -row["forwards_per_step"])

    compared = [row for row in rows if not is_baseline(row) and row["pairs"]]
    return sorted((row for row in compared if not is_number(row[SPEED]) or row[SPEED] > 1), key=order)


def _fastest(rows: Sequence[Row]) -> Row | None:
    """Return the fastest setting, those that are shown to be faster first; if none is timed, the last one tested."""
    return max(
        reversed(rows),
        key=lambda row: (row[f"{SPEED}_low"] > 1, row[SPEED]) if is_number(row[SPEED]) else (False, -math.inf),
        default=None,
    )


def pareto(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that no other one beats in both speed per episode and success, the fastest first."""

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
"""Pocock's boundary on |z| for 1, 2, … equally spaced looks and 5 %, two-sided (Jennison and Turnbull, table 2.1)."""


def confidence_of_a_look(looks: int) -> float:
    """Return the confidence of the interval at each of several looks.

    Raises:
        UsageError: More looks than the boundary is tabled for.
    """
    if not 1 <= looks <= len(_CONSTANTS):
        raise UsageError(f"until=decided with {looks} looks: at most {len(_CONSTANTS)}; set study.block higher")
    return float(1 - 2 * NormalDist().cdf(-_CONSTANTS[looks - 1]))


def decision_of(label: str, counts: stats.PairedCounts, margin: float, look: int, looks: int) -> Decision:
    """Judge a setting by a bound on the loss, given as a share of episodes."""
    difference = stats.paired_difference(counts, confidence_of_a_look(looks))
    answer = SMALLER if difference.low > -margin else LARGER if difference.high < -margin else OPEN
    return Decision(label, answer, int(sum(counts)), look, *difference)


def decisions(data: StudyData, labels: Sequence[str], margin: float, look: int, looks: int) -> list[Decision]:
    """Judge settings by all their pairs with the baseline."""
    episodes = data.episodes[data.episodes["repeat"] == 0]
    baseline = episodes[episodes["label"] == data.study.baseline]
    pairs = {label: pair_counts(paired(episodes[episodes["label"] == label], baseline)) for label in labels}
    return [decision_of(label, counts, margin, look, looks) for label, counts in pairs.items()]


def judge(loss: float, tell: Callable[[str], None]) -> InterimAnalysis:
    """Return the `analysis` of `study.run` for a bound on the loss of success.

    Args:
        loss: The bound, in points.
        tell: Takes a line of progress.
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
    """Write decided.json into the study's folder: the last decision on every label.

    Raises:
        StorageError: The disk is full or read-only.
    """
    rows = [{k: None if v != v else v for k, v in asdict(answer).items()} for answer in answers.values()]
    head = {"loss_points": loss, "looks": looks, "confidence_of_a_look": confidence_of_a_look(looks)}
    write_json(folder / "decided.json", {**head, "settings": rows})


def read_decisions(folder: Path) -> list[Row]:
    """Return the last decisions of `until=decided` in a study's folder; none if it was swept without.

    Raises:
        CheckpointError: The file is damaged.
    """
    path = folder / "decided.json"
    return list(read_json(path)["settings"]) if path.is_file() else []
