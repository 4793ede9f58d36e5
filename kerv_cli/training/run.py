"""What `kerv train target` and `kerv train drafter` have in common: identity, resuming and provenance."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import nn

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.lab.runs import Curve
from kerv_cli.methods.artifacts import removal
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.loop import Loop, Metrics, Objective, stored_identity
from kerv_cli.training.settings import TrainDrafterSettings, TrainSettings, TrainTargetSettings
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress

NOT_IDENTITY = ("steps", "validate_every", "init", "stored")
"""Settings that a resumed run may change. `init` counts by the hash of its weights, not by its name."""


class TrainingRun(ABC):
    """One training, from settings to a folder.

    The constructor checks that the run is possible, `load` reads the data, and `train` optimises and saves.

    Attributes:
        kind: The word after `kerv train`.
        artifact_kind: Kind of the artifact that is made.
        folder: Where the weights, their description and the resume file go.
        device: Set by `load`.
        objective: What is optimised; set by `load`.
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
        """Return one line for --plan: data, steps and folder."""

    @abstractmethod
    def load(self, progress: OnProgress) -> None:
        """Read the data and make the module and its objective."""

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Return what determines the run besides the optimisation settings and the demonstrations."""

    @abstractmethod
    def write(self, module: nn.Module, provenance: dict[str, Any]) -> None:
        """Write the weights and their description."""

    def train(self, on_step: Callable[[int, Metrics], None]) -> Metrics:
        """Train, from the folder's resume file if there is one, and return the metrics of the best checkpoint.

        Args:
            on_step: Called after each step and each validation with the number of steps done and the metrics.

        Raises:
            CheckpointError: The folder holds a damaged run.
            KervError: The training diverged.
            StorageError: The disk refused.
        """
        self.objective.module.train()
        keep = Curve.of(self.folder, self.settings.results).write
        return Loop(self.objective, self.save, self.settings.train, self.folder, self.hash, keep).run(on_step)

    @property
    def hash(self) -> str:
        """Hash of everything that determines the weights after a given number of steps."""
        train = optimisation_identity(self.settings.train)
        parts = {"train": train, "demos": self.dataset.sha256, **self.identity()}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def check_folder(self, setting: str) -> None:
        """Refuse a folder that holds another run. `setting` names the folder.

        Raises:
            CheckpointError: It holds one.
        """
        if stored_identity(self.folder) not in (None, self.hash):
            raise CheckpointError(
                f"{self.folder} holds a run with other settings or data: choose another {setting}=, or "
                f"{removal(self.artifact_kind, self.folder)}"
            )

    def save(self, module: nn.Module, metrics: Metrics) -> None:
        """Write the weights with their provenance and the metrics of their validation."""
        figures = {
            "demos": {"sha256": self.dataset.sha256, "config": self.dataset.manifest.config},
            "validation": metrics,
            "parameters": sum(p.numel() for p in module.parameters()),
        }
        self.write(module, provenance_of(f"kerv train {self.kind}", self.settings, self.device, **figures))


def optimisation_identity(train: TrainSettings) -> dict[str, Any]:
    """Return the optimisation settings that identify a run."""
    settings = {key: value for key, value in asdict(train).items() if key not in NOT_IDENTITY}
    settings["closed_loop"] = train.closed_loop > 0  # scores with and without success do not compare
    return settings


def refuse_unused(train: TrainSettings, keys: Sequence[str], why: str) -> None:
    """Refuse settings that the run would ignore.

    Args:
        train: The settings.
        keys: Those that the run does not read.
        why: Completes the message after `train.KEY=VALUE`.

    Raises:
        UsageError: One of them is not its default.
    """
    for key in keys:
        if (value := getattr(train, key)) != getattr(TrainSettings(), key):
            raise UsageError(f"train.{key}={value}{why}")
