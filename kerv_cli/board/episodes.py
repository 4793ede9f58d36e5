"""The pages of a study's episodes: a grid of all outcomes, and the failures in groups."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.base.errors import UnknownName
from kerv_cli.board import episode
from kerv_cli.board.pages import database_of, render
from kerv_cli.catalogue.episodes import outcomes, settings_in
from kerv_cli.episodes.identity import stress_of
from kerv_cli.lab.plan import Setting, Study
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.measures import NEAR
from kerv_cli.report.tables import StudyData

SUCCESS, FAILURE, LOST, WON, ERROR, MISSING = "success", "failure", "lost", "won", "error", "missing"
OUTCOMES = {
    LOST: ("▼", "failed, and the baseline solved it"),
    FAILURE: ("×", "failed"),
    WON: ("▲", "solved, and the baseline failed"),
    SUCCESS: ("✓", "solved"),
    ERROR: ("!", "raised an error"),
    MISSING: ("·", "has not run yet"),
}
"""Kind of outcome -> its symbol and meaning, in the order of the key."""
FAILURES = (LOST, FAILURE)

MOST_SHOWN = 24
"""Largest number of episodes that the page lists of one group of failures."""
MOVED = 0.01
"""Motion of the object, in metres, from which on a failure counts as after contact."""
PHASES = {
    "before contact": "the fingertips never came within 2 cm of the object, and did not move it",
    "near contact": "they came within 2 cm, and the object moved less than 1 cm",
    "after contact": "the object moved 1 cm or more",
    "near or after contact": "they came within 2 cm; an older kerv did not store how far the object moved",
    "unknown": "the task has no object, or the distance was not stored",
}
"""Phase of the task in which an episode failed -> what it means."""


def phase_of(closest: float | None, moved: float | None) -> str:
    """Return the phase of the task in which an episode failed, a key of PHASES.

    Args:
        closest: Least distance of the fingertips to the object, metres.
        moved: How far the object moved after they came near it, metres.
    """
    if closest is None:
        return "unknown"
    if moved is not None and moved >= MOVED:
        return "after contact"
    if closest >= NEAR:
        return "before contact"
    return "near or after contact" if moved is None else "near contact"


@dataclass(frozen=True)
class Cell:
    """One episode of the grid. `kind` is a key of OUTCOMES. `row` is its row of `outcomes`."""

    kind: str
    row: Any


@dataclass
class TaskGrid:
    """The episodes of one task.

    Attributes:
        task: Name of the task.
        seeds: All seeds. Those that fail most often come first.
        rows: Label of a setting -> seed -> cell.
    """

    task: str
    seeds: list[int] = field(default_factory=list)
    rows: dict[str, dict[int, Cell]] = field(default_factory=lambda: defaultdict(dict))

    @property
    def counts(self) -> Counter[str]:
        """Number of episodes by kind of outcome."""
        return Counter(cell.kind for row in self.rows.values() for cell in row.values())

    @property
    def failures(self) -> int:
        """Number of episodes that failed."""
        return sum(self.counts[kind] for kind in FAILURES)

    def sort(self) -> None:
        """Put the seeds that fail most often first."""
        failed = Counter(s for row in self.rows.values() for s, cell in row.items() if cell.kind in FAILURES)
        seeds = {seed for row in self.rows.values() for seed in row}
        self.seeds = sorted(seeds, key=lambda seed: (-failed[seed], seed))


def references_of(baseline: str, settings: Mapping[str, Setting]) -> dict[str, str]:
    """Return label of a setting -> label of the one that it is compared with."""
    return StudyData(Study("", tuple(settings.values()), (), baseline=baseline), pd.DataFrame()).references


def grids_of(rows: Sequence[Any], references: Mapping[str, str], label: str = "", task: str = "") -> list[TaskGrid]:
    """Arrange the outcomes of a study. Tasks that fail most often come first.

    Args:
        rows: Rows of `outcomes`.
        references: Label of a setting -> label of the one that it is compared with.
        label: Show only this setting. Empty: all.
        task: Show only this task. Empty: all.
    """
    solved = {(row.label, row.task, row.seed): row.success for row in rows if row.episode is not None}
    grids: dict[str, TaskGrid] = {}
    for row in rows:
        if row.label == (label or row.label) and row.task == (task or row.task):
            other = solved.get((references[row.label], row.task, row.seed))
            grid = grids.setdefault(row.task, TaskGrid(row.task))
            grid.rows[row.label][row.seed] = Cell(_kind(row, other), row)
    for grid in grids.values():
        grid.sort()
    return sorted(grids.values(), key=lambda grid: -grid.failures)


def _kind(row: Any, baseline: bool | None) -> str:
    """Return the kind of an outcome. `baseline` says whether the baseline solved it; None if it did not run."""
    if row.episode is None:
        return ERROR if row.failed else MISSING
    if row.success:
        return WON if baseline is False else SUCCESS
    return LOST if baseline else FAILURE


@dataclass(frozen=True)
class _Asked:
    """What a page of a study shows: its settings, all outcomes, and the filters of the address."""

    store: StudyStore
    settings: dict[str, Setting]
    baseline: str
    rows: list[Any]
    label: str
    task: str

    @property
    def tasks(self) -> list[str]:
        return sorted({row.task for row in self.rows})

    def grids(self) -> list[TaskGrid]:
        return grids_of(self.rows, references_of(self.baseline, self.settings), self.label, self.task)


def _asked(request: Request) -> _Asked:
    store = StudyStore(database_of(request), request.path_params["name"])
    baseline, settings = settings_in(store)
    label, task = (request.query_params.get(name, "") for name in ("setting", "task"))
    asked = _Asked(store, settings, baseline, outcomes(store), label, task)
    for what, value, known in (("setting", label, asked.settings), ("task", task, asked.tasks)):
        if value and value not in known:
            raise UnknownName(what, value, known)
    return asked


def show_episodes(request: Request) -> Response:
    """Show all episodes of a study as a grid."""
    asked = _asked(request)
    grids = asked.grids()
    counts = sum((grid.counts for grid in grids), Counter[str]())
    return render(request, "episodes.html", asked=asked, grids=grids, counts=counts, outcomes=OUTCOMES)


@dataclass(frozen=True)
class Cluster:
    """Failures of one task, setting, stress and phase of the task.

    Attributes:
        task: Name of the task.
        label: Label of the setting.
        stress: Kind and level of the stress. Empty: none.
        phase: A key of PHASES.
        cells: The failed episodes.
        total: Number of episodes of the task and setting that have run.
    """

    task: str
    label: str
    stress: str
    phase: str
    cells: list[Cell]
    total: int

    @property
    def lost(self) -> int:
        """Number of failures that the baseline solved."""
        return sum(cell.kind == LOST for cell in self.cells)


def clusters_of(grids: Sequence[TaskGrid], settings: Mapping[str, Setting]) -> list[Cluster]:
    """Group the failures. The largest groups come first."""
    clusters = []
    for grid in grids:
        for label, row in grid.rows.items():
            stress = stress_of(settings[label].settings)
            named = f"{stress['kind']} {stress['level']}" if stress["level"] else ""
            cells: dict[str, list[Cell]] = defaultdict(list)
            for cell in row.values():
                if cell.kind in FAILURES:
                    cells[phase_of(cell.row.closest_approach, cell.row.object_moved)].append(cell)
            total = sum(cell.row.episode is not None for cell in row.values())
            clusters += [Cluster(grid.task, label, named, phase, some, total) for phase, some in cells.items()]
    return sorted(clusters, key=lambda cluster: -len(cluster.cells))


def show_failures(request: Request) -> Response:
    """Show the failures of a study in groups."""
    asked = _asked(request)
    clusters = clusters_of(asked.grids(), asked.settings)
    counts: dict[str, Counter[str]] = {}
    for cluster in clusters:
        counts.setdefault(cluster.label, Counter())[cluster.phase] += len(cluster.cells)
    phases = {phase: why for phase, why in PHASES.items() if any(one[phase] for one in counts.values())}
    return render(
        request, "failures.html", asked=asked, clusters=clusters, counts=counts, phases=phases, most=MOST_SHOWN
    )


ROUTES = [
    Route("/studies/{name}/episodes", show_episodes),
    Route("/studies/{name}/failures", show_failures),
    *episode.ROUTES,
]
