"""`until=decided`: a sweep looks at its results after every block of seeds and stops the settings whose question is
answered: does this setting lose less than so many points of success against the baseline?

Group-sequential with Pocock's constant boundary (Biometrika 64, 1977): of K planned looks each has the same confidence,
so high that a setting exactly at the bound is misjudged at any of them with at most 5 %, both sides together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import NormalDist

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import read_json, write_json
from kerv_cli.lab.plan import Cell
from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import paired
from kerv_cli.report.tables import StudyData

SMALLER, LARGER, OPEN = "loss is smaller", "loss is larger", "open"

_CONSTANTS = (1.960, 2.178, 2.289, 2.361, 2.413, 2.453, 2.485, 2.512, 2.535, 2.555, 2.572, 2.588, 2.602, 2.614, 2.626,
              2.637, 2.646, 2.655, 2.663, 2.671)  # fmt: skip
"""Pocock's boundary on |z| for 1, 2, … equally spaced looks and 5 %, two-sided (Jennison and Turnbull, table 2.1)."""


def confidence_of_a_look(looks: int) -> float:
    """Confidence of the interval at each of so many looks.

    Raises:
        UsageError: more looks than the boundary is tabled for.
    """
    if not 1 <= looks <= len(_CONSTANTS):
        raise UsageError(f"until=decided with {looks} looks: 1 to {len(_CONSTANTS)}; set study.block higher")
    return float(1 - 2 * NormalDist().cdf(-_CONSTANTS[looks - 1]))


@dataclass(frozen=True)
class Verdict:
    """The answer for a setting at a look. difference: its success minus the baseline's; low, high: the interval at the
    look's confidence."""

    label: str
    verdict: str  # SMALLER, LARGER or OPEN
    pairs: int
    look: int  # from 1
    difference: float
    low: float
    high: float


def verdict_of(label: str, counts: stats.PairedCounts, margin: float, look: int, looks: int) -> Verdict:
    """Judges a setting. margin: the bound on the loss, a share of episodes."""
    difference = stats.paired_difference(counts, confidence_of_a_look(looks))
    answer = SMALLER if difference.low > -margin else LARGER if difference.high < -margin else OPEN
    return Verdict(label, answer, int(sum(counts)), look, difference.value, difference.low, difference.high)


def verdicts(data: StudyData, labels: Sequence[str], margin: float, look: int, looks: int) -> list[Verdict]:
    """Judges the settings of these labels by all their pairs with the baseline."""
    episodes = data.episodes[data.episodes["repeat"] == 0]
    baseline = episodes[episodes["label"] == data.plan.baseline]
    answers = []
    for label in labels:
        pairs = paired(episodes[episodes["label"] == label], baseline)
        counts = stats.paired_counts(pairs["success_baseline"].to_numpy(), pairs["success_method"].to_numpy())
        answers.append(verdict_of(label, counts, margin, look, looks))
    return answers


def looks_of(cells: Sequence[Cell], block: int) -> list[list[Cell]]:
    """The plan's cells by block of so many seeds: one look each."""
    first = min(cell.seeds[0] for cell in cells)
    groups: dict[int, list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.seeds[0] - first) // block, []).append(cell)
    return [groups[number] for number in sorted(groups)]


def write_verdicts(folder: Path, answers: Mapping[str, Verdict], loss: float, looks: int) -> None:
    """Writes decided.json into the study's folder. answers: label -> its verdict at its last look.

    Raises:
        StorageError: the disk refused.
    """
    rows = [{k: None if v != v else v for k, v in asdict(verdict).items()} for verdict in answers.values()]
    head = {"loss_points": loss, "looks": looks, "confidence_of_a_look": confidence_of_a_look(looks)}
    write_json(folder / "decided.json", {**head, "settings": rows})


def read_verdicts(folder: Path) -> pd.DataFrame | None:
    """The last answers of `until=decided` in a study's folder; None where it was swept without.

    Raises:
        CheckpointError: the file is damaged.
    """
    path = folder / "decided.json"
    return pd.DataFrame(read_json(path)["settings"]) if path.is_file() else None


def rule(loss: float, looks: int) -> str:
    """The stopping rule in one sentence."""
    confidence = 100 * confidence_of_a_look(looks)
    return (
        f"until=decided: at most {looks} looks, one per block of seeds over all tasks, each at {confidence:.1f} % "
        "(Pocock's boundary, 95 % over all looks); a setting stops when its loss of success is shown to be below or "
        f"above {loss:g} points"
    )


def summary(answers: Sequence[Verdict]) -> str:
    """Verdicts in one line, for progress."""
    clauses = [f"{v.label}: {v.verdict} after {v.pairs} pairs" for v in answers if v.verdict != OPEN]
    waiting = sum(v.verdict == OPEN for v in answers)
    return "; ".join([*clauses, f"{waiting} open"])
