"""What the commands share that make an artifact: how they begin, and which earlier training a folder holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.episodes.identity import hash_of
from kerv_cli.methods.artifacts import removal
from kerv_cli.training.fit import stored_identity
from kerv_cli.training.settings import TrainSettings
from kerv_cli.worlds.demos.dataset import DemoDataset

Stage = Callable[[str], AbstractContextManager[Callable[..., None]]]
"""Takes the title of a part of the work. Returns a context that yields a progress function (done, total)."""

Begin = Callable[[str, Path, str, int], Stage]
"""Called once all settings are checked, before the work begins.

It takes the kind and the folder of the artifact, the line that `--plan` prints, and the number of optimisation steps or
episodes (0: not known). A command passes a function that ends with the plan if `--plan` was typed. Otherwise the
function notes in the database that the work began.
"""

NOT_IDENTITY = ("steps", "validate_every", "init", "stored")
"""Optimisation settings that may change when a training resumes.

`init` is among them because the hash of its weights counts instead of its name.
"""


def quietly(kind: str, folder: Path, plan: str, units: int) -> Stage:
    """Begin an artifact without a row in the database, and show no progress. This is the default for `Begin`."""
    return lambda title: nullcontext(lambda *done: None)


def identity_of(train: TrainSettings, dataset: DemoDataset, **own: Any) -> str:
    """Return a hash of the settings and data that determine the weights after a given number of steps.

    Args:
        train: Optimisation settings.
        dataset: The demonstrations.
        **own: Further values that determine the weights, such as the network's shapes.
    """
    counted = {key: value for key, value in asdict(train).items() if key not in NOT_IDENTITY}
    counted["closed_loop"] = train.closed_loop > 0  # scores with and without success cannot be compared
    return hash_of({"train": counted, "demos": dataset.sha256, **own})


def refuse_other(folder: Path, identity: str, kind: str, setting: str) -> None:
    """Refuse a folder that holds a training with other settings or data.

    Args:
        folder: The folder.
        identity: Result of `identity_of`.
        kind: Kind of the trained artifact, for the error message.
        setting: The setting that names the folder, for the error message.

    Raises:
        CheckpointError: The folder holds another training.
    """
    if stored_identity(folder) not in (None, identity):
        raise CheckpointError(
            f"{folder} holds a run with other settings or data: choose another {setting}=, or {removal(kind, folder)}"
        )


def refuse_unused(train: TrainSettings, keys: Sequence[str], why: str) -> None:
    """Refuse optimisation settings that the training would ignore.

    Args:
        train: The optimisation settings.
        keys: Names of the settings that this training does not read.
        why: End of the error message, after `train.KEY=VALUE`.

    Raises:
        UsageError: One of the settings in `keys` differs from its default.
    """
    for key in keys:
        if (value := getattr(train, key)) != getattr(TrainSettings(), key):
            raise UsageError(f"train.{key}={value}{why}")


def figures_of(dataset: DemoDataset, network: Any, metrics: dict[str, float]) -> dict[str, Any]:
    """Return facts about a training for the artifact's description: data, validation metrics, number of parameters."""
    return {
        "demos": {"sha256": dataset.sha256, "config": dataset.manifest.config},
        "validation": metrics,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
    }
