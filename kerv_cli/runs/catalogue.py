"""Finds the runs of a results folder: sweeps, rollouts and trainings, each by its folder and what lies in it."""

from __future__ import annotations

import contextlib
import csv
import fnmatch
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from kerv_cli.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.files import read_json
from kerv_cli.studies.plan import Cell, unique_cells
from kerv_cli.studies.run_file import invocations
from kerv_cli.studies.store import ROLLOUTS, STUDIES, StudyStore

SWEEP, ROLLOUT = "sweep", "rollout"
TRAINED = ("target", "drafter", "early")
KINDS = (SWEEP, ROLLOUT, *TRAINED)
LAST = "last"
"""Stands for the newest run where one is named."""


@dataclass(frozen=True)
class RunEntry:
    """One run. id: how commands name it. state: `complete`, `2 of 6 cells`, `step 300 of 600`, `damaged`. figures: its
    headline, by name. command: behind `kerv`, as far as it is known."""

    id: str
    kind: str
    folder: Path
    started: str  # ISO 8601, UTC; of a training: when its newest file changed
    state: str
    methods: tuple[str, ...] = ()
    tasks: tuple[str, ...] = ()
    episodes: int = 0
    figures: dict[str, float] = field(default_factory=dict)
    command: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether nothing of it is left to do."""
        return self.state == "complete"


def find_runs(results: str | Path) -> list[RunEntry]:
    """Every run of the results folder, the newest first."""
    root = Path(results).expanduser()
    found = [
        *(_stored(StudyStore(root, path.parent.name)) for path in (root / STUDIES).glob("*/plan.yaml")),
        *(_stored(StudyStore(root, path.parent.name, ROLLOUTS)) for path in (root / ROLLOUTS).glob("*/plan.yaml")),
        *(_trained(path.parent, kind) for kind in TRAINED for path in (root / "artifacts" / kind).glob("*/log.csv")),
    ]
    return sorted(found, key=lambda run: (run.started, run.id), reverse=True)


def find_run(results: str | Path, name: str) -> RunEntry:
    """The run of that id, of a unique part of one, or the newest for `last`.

    Raises:
        UsageError: several runs have that part, or there is no run at all. UnknownName: none has it.
    """
    runs = find_runs(results)
    if not runs:
        raise UsageError(f"no runs in {results}: make one with 'kerv rollout method=spec_vla task=reach'")
    if name == LAST:
        return runs[0]
    exact = [run for run in runs if run.id == name]
    near = exact or [run for run in runs if name in run.id]
    if not near:
        raise UnknownName("run", name, [run.id for run in runs])
    if len(near) > 1:
        raise UsageError(f"'{name}' is a part of {len(near)} runs: {', '.join(run.id for run in near[:5])}")
    return near[0]


def matching(runs: Sequence[RunEntry], filters: dict[str, str]) -> list[RunEntry]:
    """Those runs that agree with every filter: kind, method, task (patterns such as `drawer*` too), state (a beginning
    of it) and since (ISO 8601).

    Raises:
        UnknownName: no such filter or kind.
    """
    known = ("kind", "method", "task", "state", "since")
    for key in filters:
        if key not in known:
            raise UnknownName("filter", key, known)
    if filters.get("kind", SWEEP) not in KINDS:
        raise UnknownName("kind of run", filters["kind"], KINDS)
    return [run for run in runs if _agrees(run, filters)]


def _agrees(run: RunEntry, filters: dict[str, str]) -> bool:
    task = filters.get("task", "*")
    return (
        filters.get("kind", run.kind) == run.kind
        and ("method" not in filters or any(fnmatch.fnmatch(name, filters["method"]) for name in run.methods))
        and ("task" not in filters or any(fnmatch.fnmatch(t, task) or t == f"{task}-v3" for t in run.tasks))
        and run.state.startswith(filters.get("state", ""))
        and run.started >= filters.get("since", "")
    )


def store_of(run: RunEntry) -> StudyStore:
    """The store of a sweep or rollout.

    Raises:
        UsageError: it is a training.
    """
    if run.kind in TRAINED:
        raise UsageError(f"{run.id} is a training: it has no episodes")
    return StudyStore(run.folder.parent.parent, run.folder.name, run.folder.parent.name)


def _stored(store: StudyStore) -> RunEntry:
    kind = SWEEP if store.family == STUDIES else ROLLOUT
    typed = invocations(store)
    name = store.name
    try:
        cells = unique_cells(store.read_plan().cells)
    except KervError:
        return RunEntry(name, kind, store.root, _changed(store.root / "plan.yaml"), "damaged")
    status = [found for cell in cells if (found := _status(store, cell)) is not None]
    started = [s["started"] for s in status if s.get("started")] or [command.started for command in typed]
    episodes, successes = (sum(int(s[key]) for s in status) for key in ("episodes", "successes"))
    return RunEntry(
        id=name,
        kind=kind,
        folder=store.root,
        started=min(started)[:19] if started else _changed(store.root / "plan.yaml"),
        state="complete" if len(status) == len(cells) else f"{len(status)} of {len(cells)} cells",
        methods=tuple(dict.fromkeys(str(cell.settings["method"]) for cell in cells)),
        tasks=tuple(dict.fromkeys(cell.task for cell in cells)),
        episodes=episodes,
        figures={"success": successes / episodes} if episodes else {},
        command=typed[-1].arguments if typed else (),
    )


def _status(store: StudyStore, cell: Cell) -> dict[str, Any] | None:
    """The sums in a complete cell's status.json, unchecked: a list must be quick."""
    with contextlib.suppress(CheckpointError):
        found: dict[str, Any] = read_json(store.cells / cell.id / "status.json")
        return found
    return None


def description_of(run: RunEntry) -> dict[str, Any]:
    """The provenance that a training wrote beside its weights; empty before its first validation.

    Raises:
        CheckpointError: the file is damaged.
    """
    path = run.folder / f"{run.kind}.json"
    return dict(read_json(path).get("provenance", {})) if path.is_file() else {}


def _trained(folder: Path, kind: str) -> RunEntry:
    run = RunEntry(f"{kind}/{folder.name}", kind, folder, _changed(folder / "log.csv"), "damaged")
    try:
        rows = _log(folder)
        made = description_of(run)
    except (KervError, OSError, ValueError):
        return run
    settings = made.get("settings", {})
    steps, done = int(settings.get("train", {}).get("steps", 0)), float(rows[-1]["step"]) if rows else 0.0
    figures = {name: float(value) for name, value in made.get("validation", {}).items()}
    command = tuple(str(made.get("command", "")).split()[1:])
    return RunEntry(
        id=run.id,
        kind=kind,
        folder=folder,
        started=run.started,
        state="complete" if done >= steps else f"step {done:.0f} of {steps}",
        methods=(kind,),
        tasks=tuple(settings.get("task", ())),
        figures=figures,
        command=command,
    )


def _log(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _changed(path: Path) -> str:
    try:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")[:19]
    except OSError:
        return ""


def disk_bytes(folder: Path) -> int:
    """Size of everything below a folder."""
    return sum(path.stat().st_size for path in _files(folder))


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file())
