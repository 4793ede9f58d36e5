"""Repeat a training with the settings that its description holds (`kerv runs rerun`)."""

from __future__ import annotations

import dataclasses
import itertools

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.manifests import read
from kerv_cli.base.settings import read_settings
from kerv_cli.catalogue.entries import RunEntry, again_words, description_of
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import unfinished
from kerv_cli.methods.settings import with_artifacts
from kerv_cli.training.drafter import DrafterRun
from kerv_cli.training.run import TrainingRun
from kerv_cli.training.settings import TrainDrafterSettings, TrainTargetSettings
from kerv_cli.training.target import TargetRun


def training_again(run: RunEntry, results: str) -> TrainingRun:
    """Return a training that repeats an earlier one with its stored settings.

    If an earlier repetition is unfinished, it is resumed. Otherwise the new training is named `NAME-again`.

    Args:
        run: The earlier training.
        results: The results folder.

    Raises:
        CheckpointError: The description of the earlier training is missing, damaged or of another version.
    """
    path, stored = run.folder / f"{run.kind}.json", description_of(run).get("settings")
    if not isinstance(stored, dict):
        command = "target" if run.kind == "target" else "drafter"
        raise CheckpointError(f"{path} does not say how it was trained: train a new one with 'kerv train {command}'")
    row = unfinished(Database(results), run.kind, again_words(run, results))
    if row is not None:
        name = row.name
    else:
        names = (f"{run.folder.name}-again{number if number > 1 else ''}" for number in itertools.count(1))
        name = next(candidate for candidate in names if not (run.folder.parent / candidate).exists())
    stored = stored | {"results": results}
    if run.kind == "target":
        return TargetRun(dataclasses.replace(read(TrainTargetSettings, stored, str(path)), name=name))
    settings = read_settings(TrainDrafterSettings, with_artifacts(stored))
    policy = dataclasses.replace(settings.policy, artifacts=settings.policy.artifacts | {run.kind: name})
    return DrafterRun(dataclasses.replace(settings, policy=policy))
