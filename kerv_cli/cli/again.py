"""Runs a run again from what it stored: its resolved settings, not the command that was typed."""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.manifests import read
from kerv_cli.base.settings import (
    StudySettings,
    TrainDrafterSettings,
    TrainTargetSettings,
    read_settings,
    settings_from,
)
from kerv_cli.lab.catalogue import ROLLOUT, RunEntry, description_of, find_run, store_of
from kerv_cli.lab.execute import execute
from kerv_cli.lab.identity import OBSERVATION
from kerv_cli.lab.plan import Cell, make_cell
from kerv_cli.lab.policy import check
from kerv_cli.lab.run import CellRunner, reference_decode
from kerv_cli.lab.store import STUDIES, StudyStore, new_rollout, stores
from kerv_cli.report.viewing import save_recording

if TYPE_CHECKING:
    from kerv_cli.training.runs import DrafterRun, TargetRun


@dataclass(frozen=True)
class Again:
    """A sweep or rollout that is to be repeated. cells: with ids of this code. store: a new one."""

    run: RunEntry
    study: StudySettings
    cells: list[Cell]
    store: StudyStore


def plan_again(run: RunEntry, results: str) -> Again:
    """The study, cells and store of a repetition: a new one, or that of one which was interrupted; nothing is run.

    Raises:
        CheckpointError: the weights or the data that the run used are not there any more. UsageError: as
            `policy.check`.
    """
    plan = store_of(run).read_plan()
    cells = [_again(cell, results) for cell in plan.cells]
    study = StudySettings(plan.name, plan.title, plan.baseline, axis=plan.axis)
    if (begun := _begun(run, results, cells)) is not None:
        return Again(run, dataclasses.replace(study, name=begun.name), cells, begun)
    if run.kind == ROLLOUT:
        return Again(run, study, cells, new_rollout(results, cells))
    store = StudyStore(results, _free(Path(results).expanduser() / STUDIES, plan.name))
    return Again(run, dataclasses.replace(study, name=store.name), cells, store)


def _begun(run: RunEntry, results: str, cells: list[Cell]) -> StudyStore | None:
    """The repetition of these cells that was interrupted."""
    for store in stores(Path(results).expanduser(), run.folder.parent.name):
        with contextlib.suppress(KervError):
            if store.interrupted_since(_words(run)) and {cell.id for cell in store.read_plan().cells} == {
                cell.id for cell in cells
            }:
                return store
    return None


def _words(run: RunEntry) -> list[str]:
    return ["runs", "rerun", run.id]


def _again(cell: Cell, results: str) -> Cell:
    settings = settings_from({**cell.settings, "results": results, "episodes": 1, "seed": cell.seeds[0]})
    identity = check(settings)
    for kind in cell.identity.keys() | identity.keys():
        was, now = cell.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and was != now:
            raise CheckpointError(
                f"the {kind} of {cell.label} was {was[:12]} and is {now[:12]} now: it cannot run again"
            )
    stored = {**cell.settings, "results": results}
    return make_cell(cell.label, cell.overrides, stored, identity, cell.task, cell.seeds, cell.repeat)


def run_again(again: Again, results: str) -> RunEntry:
    """Runs it in this process -> the new run.

    Raises:
        KervError: a cell failed.
    """
    again.store.begin(again.study, again.cells, _words(again.run))
    runner = CellRunner(again.store.rollouts, save_recording, keep=True)
    outcome = execute(again.cells, runner, again.store, gauge=reference_decode)
    if outcome.failed:
        raise KervError(outcome.failed[0].reason)
    again.store.note_finished()
    return find_run(results, again.store.name)


def _free(folder: Path, name: str) -> str:
    """`name-again`, or with a number behind it, where no folder has that name yet."""
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
    value: dict[str, Any] = training | {"results": results}
    name = _free(run.folder.parent, run.folder.name)
    if run.kind == "target":
        return TargetRun(dataclasses.replace(read(TrainTargetSettings, value, str(path)), name=name))
    settings = read_settings(TrainDrafterSettings, value, tolerant=True)
    others = settings.policy.others | {run.kind: name}
    return drafter_run(dataclasses.replace(settings, policy=dataclasses.replace(settings.policy, others=others)))
