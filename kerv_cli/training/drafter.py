"""`kerv train drafter`: train a drafter to imitate how the target decodes the demonstrations."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from torch import nn

from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import find
from kerv_cli.base.runtime import set_up
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.drafters import TrainableDrafter
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.targets.folders import check_not_shipped, find_target
from kerv_cli.training.demonstrations import check_tasks, demos_for
from kerv_cli.training.run import TrainingRun, refuse_unused
from kerv_cli.training.settings import TrainDrafterSettings
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import OnProgress

OF_TARGETS = ("init", "balance", "closed_loop", "colour", "places")
"""Optimisation settings that only the training of a target reads."""


class DrafterRun(TrainingRun):
    """The training of a drafter, by `kerv train drafter`.

    Raises:
        UnknownName: The kind of drafter does not exist.
        UsageError: A setting belongs to another kind of drafter, or only to the training of targets.
        CheckpointError: The target or the demonstrations do not exist, or the folder holds another training.
    """

    kind = "drafter"
    settings: TrainDrafterSettings

    def __init__(self, settings: TrainDrafterSettings) -> None:
        part = find("drafter", settings.drafter.kind, "drafter.kind")
        if not isinstance(settings.drafter, part.settings):
            raise UsageError(f"drafter.kind={part.name}: choose drafter={part.name}, each has settings of its own")
        refuse_unused(settings.train, OF_TARGETS, ": only the training of a target has this setting")
        self.artifact: TrainableDrafter = part.built()
        self.artifact_kind = self.artifact.kind
        self.target_folder = find_target(settings.results, settings.policy.target)
        self.folder = Artifacts(settings.results, settings.policy).new(self.artifact_kind)
        check_not_shipped(self.folder, f"policy.artifacts.{self.artifact_kind}")
        self.settings, self.dataset = demos_for(settings)
        if self.settings.task:
            names = resolve_tasks(self.settings.task)
            check_tasks(self.dataset, names)
            self.dataset = replace(self.dataset, episodes=[e for e in self.dataset.episodes if e.task in names])
        self.description = read_target(self.target_folder)
        self.description.check_autoregressive(
            f"policy.target={settings.policy.target}", "there are no greedy decodes to imitate"
        )
        self.check_folder(f"policy.artifacts.{self.artifact_kind}")

    def plan(self) -> str:
        """Return one line that `--plan` prints: target, number of observations, number of steps and folder."""
        drafter, train = asdict(self.settings.drafter), self.settings.train
        layers = f"{drafter['layers']}-layer " if "layers" in drafter else ""
        samples = f", greedy decodes of {drafter['samples']} observations" if "samples" in drafter else ""
        return (
            f"{self.folder}: {layers}{self.artifact.noun} of {self.target_folder}{samples}, {train.steps} steps of "
            f"{train.batch}"
        )

    def load(self, progress: OnProgress) -> None:
        """Load the target in the number format `runtime.dtype`, decode demonstrations with it, and make the drafter.

        The drafter's own weights are trained in float32.

        Raises:
            CheckpointError: The target or the demonstrations are damaged.
            UsageError: The device does not exist.
        """
        self.device, dtype = set_up(self.settings.runtime)
        target: Any = load_target(self.target_folder, self.device, dtype)[0]
        self.objective = self.artifact.objective(target, self.dataset, self.settings, progress)

    def identity(self) -> dict[str, Any]:
        """Return the drafter's settings, the hash of the target's weights, the tasks, and the number format.

        float32 is left out, so that trainings from before it counted can be resumed.
        """
        task, dtype = self.settings.task, self.settings.runtime.dtype
        tasks = list(resolve_tasks(task)) if task else []
        shared = {"drafter": asdict(self.settings.drafter), "target": self.description.sha256, "task": tasks}
        return shared if dtype == "float32" else {**shared, "dtype": dtype}

    def write(self, module: nn.Module, provenance: dict[str, Any]) -> None:
        """Write the weights and their description into the drafter's folder."""
        made_for, stored = MadeFor.of(self.description), self.settings.train.stored
        self.artifact.save(self.folder, module, made_for, provenance, stored, settings=asdict(self.settings.drafter))
