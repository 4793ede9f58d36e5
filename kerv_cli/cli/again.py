"""Runs a run again from what it stored: its resolved settings, not the command that was typed."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.manifests import read
from kerv_cli.base.settings import (
    RuntimeSettings,
    StudySettings,
    TrainDrafterSettings,
    TrainTargetSettings,
    read_settings,
    settings_from,
)
from kerv_cli.cli.running import running
from kerv_cli.lab.catalogue import ROLLOUT, RunEntry, description_of, find_run, store_of
from kerv_cli.lab.identity import OBSERVATION
from kerv_cli.lab.plan import Cell, make_cell
from kerv_cli.lab.policy import check
from kerv_cli.lab.store import STUDIES, StudyStore, new_rollout, stores

if TYPE_CHECKING:
    from kerv_cli.training.runs import DrafterRun, TargetRun


def cells_again(run: RunEntry, results: str) -> list[Cell]:
    """The cells of a sweep or rollout, with ids of this code.

    Raises:
        CheckpointError: the weights or the data that the run used are not there any more. UsageError: as
            `policy.check`.
    """
    return [_again(cell, results) for cell in store_of(run).read_plan().cells]


def _again(cell: Cell, results: str) -> Cell:
    stored = {**cell.settings, "results": results}
    identity = check(settings_from({**stored, "episodes": 1, "seed": cell.seeds[0]}))
    for kind in cell.identity.keys() | identity.keys():
        was, now = cell.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and was != now:
            raise CheckpointError(
                f"the {kind} of {cell.label} was {was[:12]} and is {now[:12]} now: it cannot run again"
            )
    return make_cell(cell.label, cell.overrides, stored, identity, cell.task, cell.seeds, cell.repeat)


def store_again(run: RunEntry, results: str, cells: list[Cell]) -> StudyStore:
    """The store for a repetition of these cells: a new one, or that of a repetition which was interrupted."""
    ids = {cell.id for cell in cells}
    for store in stores(Path(results).expanduser(), run.folder.parent.name):
        with contextlib.suppress(KervError):
            if store.interrupted_since(["runs", "rerun", run.id]) and {c.id for c in store.read_plan().cells} == ids:
                return store
    if run.kind == ROLLOUT:
        return new_rollout(results, cells)
    return StudyStore(results, _free(Path(results).expanduser() / STUDIES, run.id))


def run_again(run: RunEntry, store: StudyStore, cells: list[Cell]) -> RunEntry:
    """Runs the cells in this process -> the new run.

    Raises:
        KervError: a cell failed. Interrupted: Ctrl-C.
    """
    plan = store_of(run).read_plan()
    store.begin(StudySettings(store.name, plan.title, plan.baseline, axis=plan.axis), cells, ["runs", "rerun", run.id])
    with running(store, cells, RuntimeSettings()) as execute:
        failed = execute(cells).failed
    if failed:
        raise KervError(failed[0].reason)
    store.note_finished()
    return find_run(store.root.parent.parent, store.name)


def _free(folder: Path, name: str) -> str:
    """`name-again` or `name-again2`, …: the first that is no folder yet."""
    names = (f"{name}-again{number if number > 1 else ''}" for number in range(1, 1000))
    return next(candidate for candidate in names if not (folder / candidate).exists())


def training_again(run: RunEntry, results: str) -> TargetRun | DrafterRun:
    """The training run with the stored settings under a free name.

    Raises:
        CheckpointError: its description is missing, damaged or of another version.
    """
    from kerv_cli.training.runs import TargetRun, drafter_run

    path = run.folder / f"{run.kind}.json"
    training = description_of(run).get("settings")
    if not isinstance(training, dict):
        command = "target" if run.kind == "target" else "drafter"
        raise CheckpointError(f"{path} does not say how it was trained: train anew with 'kerv train {command}'")
    value = training | {"results": results}
    name = _free(run.folder.parent, run.folder.name)
    if run.kind == "target":
        return TargetRun(dataclasses.replace(read(TrainTargetSettings, value, str(path)), name=name))
    settings = read_settings(TrainDrafterSettings, value)
    others = settings.policy.others | {run.kind: name}
    return drafter_run(dataclasses.replace(settings, policy=dataclasses.replace(settings.policy, others=others)))
