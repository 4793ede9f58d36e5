"""The base of `kerv train target` and `kerv train drafter`: check the folder, load, train, resume, save."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import nn

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.episodes.identity import hash_of
from kerv_cli.methods.artifacts import removal
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.loop import Loop, Metrics, Objective, stored_identity
from kerv_cli.training.settings import TrainDrafterSettings, TrainSettings, TrainTargetSettings
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress

NOT_IDENTITY = ("steps", "validate_every", "init", "stored")
"""Optimisation settings that may change when a training resumes.

`init` is among them because the hash of its weights counts instead of its name.
"""


class TrainingRun(ABC):
    """One training. The constructor checks the settings, `load` reads the data, and `train` optimises and saves.

    Attributes:
        kind: The word after `kerv train`: `target` or `drafter`.
        artifact_kind: Kind of the trained artifact, such as `target`, `drafter` or `early`.
        settings: Settings of the command.
        dataset: The demonstrations.
        folder: Folder for the weights, their description and the resume file.
        device: Device of the training, such as `cuda`. `load` sets it.
        objective: The network, its samples and its loss, as `loop.Loop` takes them. `load` sets it.
    """

    kind: str
    artifact_kind: str
    settings: TrainTargetSettings | TrainDrafterSettings
    dataset: DemoDataset
    folder: Path
    device: str
    objective: Objective

    @abstractmethod
    def plan(self) -> str:
        """Return one line that `--plan` prints: the data, the number of steps and the folder."""

    @abstractmethod
    def load(self, progress: OnProgress) -> None:
        """Read the data, and set `device` and `objective`."""

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Return everything that determines the weights, except the optimisation settings and the demonstrations."""

    @abstractmethod
    def write(self, module: nn.Module, provenance: dict[str, Any]) -> None:
        """Write the weights and their description into the folder.

        Args:
            module: The network with the best weights so far.
            provenance: How it was made: command, settings, versions, demonstrations and metrics.
        """

    def train(self, on_step: Callable[[int, Metrics], None]) -> Metrics:
        """Train, from the folder's resume file if there is one, and return the metrics of the best weights.

        Args:
            on_step: Called after each step and each validation, with the number of steps done and the metrics.

        Raises:
            CheckpointError: The resume file is damaged.
            KervError: The training diverged.
            StorageError: The disk cannot be written.
            Interrupted: The process got Ctrl-C or SIGTERM. The state is saved.
        """
        self.objective.module.train()
        return Loop(self.objective, self.save, self.settings.train, self.folder, self.hash).run(on_step)

    @property
    def hash(self) -> str:
        """Hash of everything that determines the weights after a given number of steps."""
        train = {key: value for key, value in asdict(self.settings.train).items() if key not in NOT_IDENTITY}
        train["closed_loop"] = train["closed_loop"] > 0  # scores with and without success cannot be compared
        return hash_of({"train": train, "demos": self.dataset.sha256, **self.identity()})

    def check_folder(self, setting: str) -> None:
        """Refuse a folder that holds a training with other settings or data.

        Args:
            setting: The setting that names the folder, for the error message.

        Raises:
            CheckpointError: The folder holds another training.
        """
        if stored_identity(self.folder) not in (None, self.hash):
            raise CheckpointError(
                f"{self.folder} holds a run with other settings or data: choose another {setting}=, or "
                f"{removal(self.artifact_kind, self.folder)}"
            )

    def save(self, module: nn.Module, metrics: Metrics) -> None:
        """Write the weights, with their provenance and the metrics of their validation."""
        figures = {
            "demos": {"sha256": self.dataset.sha256, "config": self.dataset.manifest.config},
            "validation": metrics,
            "parameters": sum(p.numel() for p in module.parameters()),
        }
        self.write(module, provenance_of(f"kerv train {self.kind}", self.settings, self.device, **figures))


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
