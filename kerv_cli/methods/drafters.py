"""A drafter with weights is one class: it trains, saves, loads and proposes (docs/extending.md)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sized
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.artifacts import Artifact, Artifacts, MadeFor, removal
from kerv_cli.methods.context import Context
from kerv_cli.targets import checkpoint
from kerv_cli.targets.compact.packable import load_packed
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress

Metrics = dict[str, float]


@dataclass(frozen=True, kw_only=True)
class DrafterDescription(checkpoint.Description):
    """The JSON of a drafter; a kind may add fields.

    Attributes:
        target: Hash of the target's weights.
        actions: The target's action space.
        chunk: The target's H; 0 if it does not matter.
        settings: Its shapes and those of its training.
        provenance: How it was made.
    """

    target: str
    actions: ActionSpace
    chunk: int = 0
    settings: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Training:
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


class TrainableDrafter(Artifact[DrafterDescription]):
    """Base of drafters with weights, in safetensors and `<kind>.json`. `registry.add_drafter` registers one.

    Attributes:
        settings: Dataclass of its shapes and training.
        any_chunk: Whether it drafts for any H.
    """

    schema = DrafterDescription
    settings: type[Any]
    any_chunk = False

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
    def loss(self, training: Training, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Return the loss of the examples `indices` (B,), and numbers to log."""

    @abstractmethod
    def validate(self, training: Training, module: Any) -> Metrics:
        """Return metrics of a module on the held-out examples, among them a `score`: higher is better."""

    @classmethod
    @abstractmethod
    def proposer(cls, settings: Any, context: Context) -> Proposer:
        """Return what drafts with the weights in `context.artifact(kind)`."""

    def objective(self, target: Any, dataset: DemoDataset, settings: Any, progress: OnProgress) -> Training:
        """Read the demonstrations through the target; return what the optimisation loop trains."""
        share = settings.train.held_out
        examples, held_out = self.examples(target, dataset, settings.drafter, share, progress)
        torch.manual_seed(settings.train.seed)
        network = self.network(settings.drafter, target)
        self.prepare(network, examples)
        return Training(self, network.to(target.device), target, examples, held_out, settings)

    def anew(self, path: Path) -> str:
        """Return how to replace one of another target: a training goes on only with its own."""
        return f"{removal(self.kind, path)}, then {self.again}"

    def load(self, path: Path, artifacts: Artifacts) -> Any:
        """Return the network with its weights, frozen, on the target's device in its number format."""
        target, description = artifacts.target, self.checked(path, artifacts.description)
        settings = read(self.settings, description.settings, f"the {self.noun}'s settings", tolerant=True)
        return load_packed(self.network(settings, target), path, self.kind, target.device, target.dtype)

    def digest(self, path: Path, description: DrafterDescription) -> str:
        """Return the hash of the weights."""
        return description.sha256

    def described(self, file: Path) -> DrafterDescription:
        """Return the description in a file, after checking the weights beside it."""
        return checkpoint.read_description(file.parent, self.kind, self.schema)

    def save(
        self,
        path: Path,
        module: nn.Module,
        made_for: MadeFor,
        provenance: Mapping[str, Any],
        stored: str = checkpoint.FLOAT32,
        **fields: Any,
    ) -> str:
        """Write weights and description.

        Args:
            path: The folder.
            module: The network.
            made_for: Its target.
            provenance: How it was made.
            stored: Number format on disk, as `train.stored`.
            fields: Further fields of this kind's description.

        Returns:
            The hash of the weights.
        """
        shared = {"target": made_for.sha256, "actions": made_for.actions.as_dict(), "provenance": dict(provenance)}
        chunk = {} if self.any_chunk else {"chunk": made_for.chunk}
        return checkpoint.save_module(path, self.kind, module, {**fields, **shared, **chunk}, stored)
