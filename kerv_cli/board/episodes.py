"""The pages of a study's episodes: a grid of all outcomes, and the failures in groups."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.base.errors import UnknownName
from kerv_cli.board import episode
from kerv_cli.board.pages import database_of, render
from kerv_cli.catalogue.episodes import outcomes
from kerv_cli.episodes.identity import Setting, stress_of
from kerv_cli.lab.store import Study
from kerv_cli.report.measures import NEAR
from kerv_cli.report.tables import references_of

SUCCESS, FAILURE, LOST, WON, ERROR, MISSING = "success", "failure", "lost", "won", "error", "missing"
# Kind of outcome -> its symbol and its meaning, in the order of the page's legend
OUTCOMES = {
    LOST: ("▼", "only the baseline solved it"),
    FAILURE: ("×", ""),
    WON: ("▲", "only this setting solved it"),
    SUCCESS: ("✓", ""),
    ERROR: ("!", "could not run"),
    MISSING: ("·", "not run yet"),
}
FAILURES = (LOST, FAILURE)

# Episodes that the page lists for each group of failures
MOST_SHOWN = 24
# Metres. If the object moved at least this far, a failure counts as after contact.
MOVED = 0.01
# Phase of a task in which an episode can fail -> what it means
PHASES = {
    "before contact": "the fingertips never came within 2 cm of the object, and did not move it",
    "near contact": "they came within 2 cm, and the object moved less than 1 cm",
    "after contact": "the object moved 1 cm or more",
    "near or after contact": "they came within 2 cm; an older kerv did not store how far the object moved",
    "unknown": "the task has no object, or the distance was not stored",
}


def phase_of(closest: float | None, moved: float | None) -> str:
    """Return the phase of the task in which an episode failed, a key of PHASES.

    Args:
        closest: Least distance of the fingertips to the object, metres. None if unknown.
        moved: How far the object moved after the fingertips came near it, metres. None if unknown.
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
    """One episode of a study.

    Attributes:
        episode: Row number of the episode in the database. None if the episode has not run.
        kind: Outcome of the episode, a key of OUTCOMES.
        phase: How far the robot got, a key of PHASES. The page shows it only for failures.
        stress: Kind and level of the episode's stress, such as `push 2`. Empty without stress.
    """

    label: str
    task: str
    seed: int
    episode: int | None
    kind: str
    phase: str
    stress: str


@dataclass(frozen=True)
class Grid:
    """The episodes of one task, as a table with one row per setting and one column per seed.

    Attributes:
        seeds: The seeds with the most failures come first.
        rows: The episodes of each setting, by the setting's label and then by seed.
        total: Number of all episodes, also those that have not run.
    """

    task: str
    seeds: list[int]
    rows: dict[str, dict[int, Cell]]
    failed: int
    total: int


def cells_of(rows: Sequence[Any], baseline: str, settings: Mapping[str, Setting]) -> list[Cell]:
    """Return a cell for every row of `outcomes`. Its kind compares the outcome with the baseline's."""
    references = references_of(list(settings.values()), baseline)
    names = {}
    for label, one in settings.items():
        stress = stress_of(one.settings)
        names[label] = f"{stress['kind']} {stress['level']}" if stress["level"] else ""
    solved = {(row.label, row.task, row.seed): row.success for row in rows if row.episode is not None}
    cells = []
    for row in rows:
        kind = _kind(row, solved.get((references[row.label], row.task, row.seed)))
        phase = phase_of(row.closest_approach, row.object_moved)
        cells.append(Cell(row.label, row.task, row.seed, row.episode, kind, phase, names[row.label]))
    return cells


def _kind(row: Any, baseline: bool | None) -> str:
    if row.episode is None:
        return ERROR if row.failed else MISSING
    if row.success:
        return WON if baseline is False else SUCCESS
    return LOST if baseline else FAILURE


def grids_of(cells: Sequence[Cell]) -> list[Grid]:
    """Arrange episodes by task. The tasks with the most failures come first."""
    tasks: dict[str, list[Cell]] = defaultdict(list)
    for cell in cells:
        tasks[cell.task].append(cell)
    grids = []
    for task, some in tasks.items():
        failed: Counter[int] = Counter()
        rows: dict[str, dict[int, Cell]] = defaultdict(dict)
        for cell in some:
            rows[cell.label][cell.seed] = cell
            failed[cell.seed] += cell.kind in FAILURES
        seeds = sorted(failed, key=lambda seed: (-failed[seed], seed))
        grids.append(Grid(task, seeds, rows, failed.total(), len(some)))
    return sorted(grids, key=lambda grid: -grid.failed)


def clusters_of(cells: Sequence[Cell]) -> list[tuple[list[Cell], int]]:
    """Group failures by task, setting and phase, the largest group first.

    Each comes with the number of all episodes of its task and setting that have run.
    """
    groups: dict[tuple[str, ...], list[Cell]] = defaultdict(list)
    ran: Counter[tuple[str, str]] = Counter()
    for cell in cells:
        if cell.kind in FAILURES:
            groups[cell.task, cell.label, cell.phase].append(cell)
        ran[cell.task, cell.label] += cell.episode is not None
    return [(some, ran[some[0].task, some[0].label]) for some in sorted(groups.values(), key=len, reverse=True)]


def _asked(request: Request) -> tuple[list[Cell], dict[str, Any]]:
    """Return the study's episodes, of the setting and task that the address names, and values for the templates."""
    store = Study(database_of(request), request.path_params["name"])
    study = store.load()
    baseline, settings = study.baseline, {one.label: one for one in study.settings}
    cells = cells_of(outcomes(store), baseline, settings)
    known = {"setting": list(settings), "task": sorted(set(map(attrgetter("task"), cells)))}
    chosen = {name: request.query_params.get(name, "") for name in known}
    for name, value in chosen.items():
        if value and value not in known[name]:
            raise UnknownName(name, value, known[name])
    cells = [cell for cell in cells if chosen["setting"] in ("", cell.label) and chosen["task"] in ("", cell.task)]
    return cells, {"study": store.name, "baseline": baseline, "known": known, "chosen": chosen}


def show_episodes(request: Request) -> Response:
    cells, asked = _asked(request)
    counts = Counter(map(attrgetter("kind"), cells))
    return render(request, "episodes.html", grids=grids_of(cells), counts=counts, outcomes=OUTCOMES, **asked)


def show_failures(request: Request) -> Response:
    cells, asked = _asked(request)
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for cell in cells:
        if cell.kind in FAILURES:
            counts[cell.label][cell.phase] += 1
    seen = set().union(*counts.values())
    phases = {phase: why for phase, why in PHASES.items() if phase in seen}
    shown: dict[str, Any] = {"clusters": clusters_of(cells), "counts": counts, "phases": phases, "most": MOST_SHOWN}
    return render(request, "failures.html", **shown, **asked)


ROUTES = [
    Route("/studies/{name}/episodes", show_episodes),
    Route("/studies/{name}/failures", show_failures),
    *episode.ROUTES,
]
