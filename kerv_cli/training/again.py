"""Trains again what was trained, from the settings that its description holds."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.manifests import read
from kerv_cli.base.settings import read_settings
from kerv_cli.catalogue.again import again_words
from kerv_cli.catalogue.entries import RunEntry, description_of
from kerv_cli.lab.database import COMPLETE, Database
from kerv_cli.lab.runs import run_rows
from kerv_cli.methods.settings import with_artifacts
from kerv_cli.training.drafter import DrafterRun
from kerv_cli.training.run import TrainingRun
from kerv_cli.training.settings import TrainDrafterSettings, TrainTargetSettings
from kerv_cli.training.target import TargetRun


def training_again(run: RunEntry, results: str) -> TrainingRun:
    """Return the training with the stored settings, under a free name, or that of an interrupted repetition.

    Raises:
        CheckpointError: Its description is missing, damaged or of another version.
    """
    path = run.folder / f"{run.kind}.json"
    training = description_of(run).get("settings")
    if not isinstance(training, dict):
        command = "target" if run.kind == "target" else "drafter"
        raise CheckpointError(f"{path} does not say how it was trained: train anew with 'kerv train {command}'")
    value = training | {"results": results}
    words = tuple(again_words(run, results))
    rows = [row for row in run_rows(Database(results), run.kind) if row.command == words]
    name = rows[0].name if rows and rows[0].status != COMPLETE else _free(run.folder)
    if run.kind == "target":
        return TargetRun(dataclasses.replace(read(TrainTargetSettings, value, str(path)), name=name))
    settings = read_settings(TrainDrafterSettings, with_artifacts(value))
    policy = dataclasses.replace(settings.policy, artifacts=settings.policy.artifacts | {run.kind: name})
    return DrafterRun(dataclasses.replace(settings, policy=policy))


def _free(folder: Path) -> str:
    """Return `NAME-again` or `NAME-again2`, …: the first that is no folder yet."""
    names = (f"{folder.name}-again{number if number > 1 else ''}" for number in range(1, 1000))
    return next(candidate for candidate in names if not (folder.parent / candidate).exists())
