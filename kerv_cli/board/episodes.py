"""The pages of a study's episodes: a grid of all outcomes, and the failures in groups."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

from markupsafe import Markup
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.base.errors import UnknownName
from kerv_cli.board import episode
from kerv_cli.board.pages import database_of, render
from kerv_cli.catalogue.episodes import outcomes
from kerv_cli.episodes.identity import Setting, stress_of
from kerv_cli.lab.store import Study, loaded
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
    "unknown": "the task has no object, or the distance was not stored",
}


def phase_of(closest: float | None, moved: float | None) -> str:
    """Return the phase of the task in which an episode failed, a key of PHASES.

    Args:
        closest: Least distance of the fingertips to the object, metres. None if unknown.
        moved: How far the object moved after the fingertips came near it, metres. None if they never did.
    """
    if closest is None:
        return "unknown"
    if moved is not None and moved >= MOVED:
        return "after contact"
    return "before contact" if closest >= NEAR else "near contact"


class Cell(NamedTuple):
    """One episode of a study."""

    label: str
    task: str
    seed: int
    episode: int | None  # row number in the database; None if it has not run
    kind: str  # a key of OUTCOMES
    phase: str  # a key of PHASES: how far the robot got. Shown only for failures
    stress: str  # kind and level, such as `push 2`; empty without stress

    @property
    def html(self) -> str:
        symbol = OUTCOMES[self.kind][0]
        if self.episode is None:
            return f'<span class="cell {self.kind}">{symbol}</span>'
        link = f'href="/episodes/{self.episode}" title="{self.seed} {self.kind}"'
        return f'<a class="cell {self.kind}" {link}>{symbol}</a>'


@dataclass(frozen=True)
class Grid:
    """The episodes of one task, as a table with one row per setting and one column per seed."""

    task: str
    seeds: list[int]  # those with the most failures first
    rows: dict[str, dict[int, str]]  # label -> seed -> the episode's cell as HTML
    failed: int
    total: int  # also those that have not run

    def columns(self, label: str) -> Markup:
        """Return a row's cells as HTML. Rendering 10,000 cells in a template would take five times as long."""
        row = self.rows[label]
        return Markup("".join([f"<td>{row.get(seed, '')}</td>" for seed in self.seeds]))


def cells_of(rows: Sequence[Any], baseline: str, settings: Mapping[str, Setting]) -> list[Cell]:
    """Return a cell for each row from `outcomes`. Its kind says how the episode compares with the baseline's."""
    references = references_of(list(settings.values()), baseline)
    names = {}
    for label, one in settings.items():
        stress = stress_of(one.settings)
        names[label] = f"{stress['kind']} {stress['level']}" if stress["level"] else ""
    solved = {(label, task, seed): success for label, task, seed, one, success, *_ in rows if one is not None}
    cells = []
    for label, task, seed, one, success, closest, moved, has_failed in rows:
        kind = ERROR if has_failed else MISSING
        if one is not None:
            kind = _kind(success, solved.get((references[label], task, seed)))
        cells.append(Cell(label, task, seed, one, kind, phase_of(closest, moved), names[label]))
    return cells


def _kind(success: bool, baseline: bool | None) -> str:
    if success:
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
        rows: dict[str, dict[int, str]] = defaultdict(dict)
        for cell in some:
            rows[cell.label][cell.seed] = cell.html
            failed[cell.seed] += cell.kind in FAILURES
        seeds = sorted(failed, key=lambda seed: (-failed[seed], seed))
        grids.append(Grid(task, seeds, rows, failed.total(), len(some)))
    return sorted(grids, key=lambda grid: -grid.failed)


def clusters_of(cells: Sequence[Cell]) -> list[tuple[list[Cell], int]]:
    """Group failures by task, setting and phase, the largest group first.

    Each group comes with the number of episodes of its task and setting that have run.
    """
    groups: dict[tuple[str, ...], list[Cell]] = defaultdict(list)
    ran: Counter[tuple[str, str]] = Counter()
    for cell in cells:
        if cell.kind in FAILURES:
            groups[cell.task, cell.label, cell.phase].append(cell)
        ran[cell.task, cell.label] += cell.episode is not None
    return [(some, ran[some[0].task, some[0].label]) for some in sorted(groups.values(), key=len, reverse=True)]


def _asked(request: Request) -> tuple[list[Cell], dict[str, Any]]:
    """Return the cells of the study, setting and task in the address, and further values for the templates."""
    store = Study(database_of(request), request.path_params["name"])
    study = loaded(store, episodes=False)
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
