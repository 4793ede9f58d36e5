"""A drafter with weights is one class: it trains, saves, loads and proposes (docs/extending.md)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sized
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from kerv_cli.base.manifests import read
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.methods.artifacts import Weights, WeightsDescription
from kerv_cli.methods.context import Context
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress

Metrics = dict[str, float]


@dataclass(frozen=True, kw_only=True)
class DrafterDescription(WeightsDescription):
    """The JSON of a drafter: `settings` are its shapes and those of its training."""

    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Lesson:
    """One training of a drafter, as the optimisation loop sees it.

    Attributes:
        drafter: Has the loss and the validation.
        module: The network that is trained.
        target: The frozen target that it imitates.
        examples: What it is trained on.
        held_out: Examples of other episodes, for validation.
        settings: Those of the command: `drafter` of this drafter, `train` of the optimisation.
    """

    drafter: TrainableDrafter
    module: Any
    target: Any
    examples: Any
    held_out: Any
    settings: Any

    def __len__(self) -> int:
        """Return the number of examples."""
        return len(self.examples)

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Return the drafter's loss of the examples `indices` (B,), and numbers to log."""
        return self.drafter.loss(self, indices, step)

    @torch.no_grad()
    def validate(self, module: nn.Module) -> Metrics:
        """Return the drafter's metrics of a module."""
        return self.drafter.validate(self, module)


class TrainableDrafter(Weights[DrafterDescription]):
    """Base of drafters with weights. `registry.add_drafter` registers one.

    Attributes:
        settings: Dataclass of its shapes and training.
    """

    schema = DrafterDescription
    settings: type[Any]

    @property
    def command(self) -> tuple[str, ...]:  # type: ignore[override]
        """Words after `kerv` that train one."""
        return "train", "drafter", f"drafter={self.settings().kind}"

    @abstractmethod
    def network(self, settings: Any, target: Any) -> nn.Module:
        """Return a fresh network for a target."""

    @abstractmethod
    def examples(
        self,
        target: Any,
        dataset: DemoDataset,
        settings: Any,
        held_out: float,
        progress: OnProgress,
    ) -> tuple[Sized, Sized]:
        """Read the demonstrations through the target -> (training, held out), of different episodes.

        Args:
            target: The loaded target, on the device to train on.
            dataset: The demonstrations.
            settings: The drafter's.
            held_out: Share of the episodes that is held out.
            progress: Called with (done, total).
        """

    def prepare(self, network: Any, examples: Any) -> None:
        """Set what a fresh network takes from its examples."""

    @abstractmethod
    def loss(self, lesson: Lesson, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Return the loss of the examples `indices` (B,), and numbers to log."""

    @abstractmethod
    def validate(self, lesson: Lesson, module: Any) -> Metrics:
        """Return metrics of a module on the held-out examples, among them a `score`: higher is better."""

    @classmethod
    @abstractmethod
    def proposer(cls, settings: Any, context: Context) -> Proposer:
        """Return what drafts with the weights in `context.artifact(kind)`."""

    def module(self, description: DrafterDescription, target: ReadableTarget) -> nn.Module:
        """Return a fresh network of this description."""
        settings = read(self.settings, description.settings, f"the {self.noun}'s settings", tolerant=True)
        return self.network(settings, target)

    def objective(self, target: Any, dataset: DemoDataset, settings: Any, progress: OnProgress) -> Lesson:
        """Read the demonstrations through the target; return what the optimisation loop trains."""
        share = settings.train.held_out
        examples, held_out = self.examples(target, dataset, settings.drafter, share, progress)
        torch.manual_seed(settings.train.seed)
        network = self.network(settings.drafter, target)
        self.prepare(network, examples)
        return Lesson(self, network.to(target.device), target, examples, held_out, settings)
