"""Base class of drafters with weights: training examples, loss, files and proposer (docs/extending.md)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.artifacts import Artifact, Artifacts, MadeFor
from kerv_cli.methods.context import Context
from kerv_cli.targets import checkpoint
from kerv_cli.targets.samples import Rows, observed_steps, split
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.files import DemoEpisode

if TYPE_CHECKING:
    from torch import Tensor, nn

Metrics = dict[str, float]


@dataclass(frozen=True, kw_only=True)
class DrafterDescription(checkpoint.Description):
    """Contents of the JSON file beside a drafter's weights. A kind of drafter may add fields.

    Attributes:
        target: Hash of the target's weights.
        chunk: The target's number of control steps per chunk. If 0, the drafter works with any number.
        settings: Settings of the network's shapes and of the training.
    """

    target: str
    actions: ActionSpace
    chunk: int = 0
    settings: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Decodes(Rows):
    """Training examples of a drafter: the tokens that the target decodes greedily from n observations.

    Each kind of drafter has a subclass that adds the inputs of its network.

    Attributes:
        tokens: (n, N) int64, the N tokens of each chunk.
        episodes: (n,) int64, index of the observation's episode.
        perturbed: (n,) bool, whether the observation's episode was executed with noise.
    """

    tokens: Tensor
    episodes: Tensor
    perturbed: Tensor


def evenly(steps: np.ndarray, share: float) -> np.ndarray:
    """Choose a share (above 0, at most 1) of `steps` (n,), evenly spread. The first step is always included."""
    order = np.arange(len(steps))
    return steps[np.ceil((order + 1) * share - 1e-9) > np.ceil(order * share - 1e-9)]


class TrainableDrafter(Artifact[DrafterDescription]):
    """Base class of the drafters that are trained, such as the early drafter. `DrafterPart` registers a subclass.

    A trained drafter is a folder with the weights in safetensors and a description `<kind>.json`.

    Attributes:
        settings: Dataclass of the settings, which are shapes of the network and parameters of the training.
        any_chunk: Whether a trained drafter works for any number of control steps per chunk.
    """

    schema = DrafterDescription
    settings: type[Any]
    any_chunk = False

    @property
    def command(self) -> tuple[str, ...]:  # type: ignore[override]
        return "train", "drafter", f"drafter={self.settings().kind}"

    @abstractmethod
    def network(self, settings: Any, target: Any) -> nn.Module:
        """Return a network with initial weights, for drafting for `target`."""

    def examples(
        self, target: Any, dataset: DemoDataset, settings: Any, held_out: float, progress: OnProgress
    ) -> tuple[Any, Any]:
        """Decode about `settings.samples` observations with the target, spread evenly over all episodes.

        Args:
            dataset: The demonstrations. The expert's actions are not used.
            held_out: Share of the episodes to hold out.
            progress: Called with the number of episodes done and the number of all episodes.

        Returns:
            The training examples, and the held-out examples, which come from other episodes.

        Raises:
            CheckpointError: There is only one episode, an episode is damaged, or its images have another size than the
                target takes.
        """
        import torch

        sees, count = bool(target.cameras), len(dataset.episodes)
        stride = int(dataset.manifest.config["frame_stride"]) if sees else 1  # control steps per stored image
        share = min(1.0, settings.samples * stride / sum(episode.steps for episode in dataset.episodes))
        parts: list[Decodes] = []
        for index in range(count):
            episode = dataset.load(index)
            steps = evenly(observed_steps(episode, sees), share)
            size = (len(steps),)
            columns = {"episodes": torch.full(size, index), "perturbed": torch.full(size, episode.perturbed)}
            with torch.inference_mode():
                parts.append(self.decoded(target, episode, steps, dataset.manifest.observation, columns))
            progress(index + 1, count)
        return split(type(parts[0]).joined(parts), held_out)

    def decoded(
        self, target: Any, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace, columns: dict[str, Tensor]
    ) -> Decodes:
        """Decode some observations of an episode greedily with the target.

        Args:
            steps: (n,) control steps of the observations.
            space: Observation space of the demonstrations.
            columns: Values of the result's fields `episodes` and `perturbed`.
        """
        raise NotImplementedError

    def prepare(self, network: Any, examples: Any) -> None:
        """Store numbers from the training examples in the network before training, such as their mean and spread."""

    @abstractmethod
    def loss(self, network: Any, target: Any, batch: Any, step: int, settings: Any) -> tuple[Tensor, Metrics]:
        """Return the loss (a scalar) of a batch of examples, and metrics to log.

        Args:
            target: The frozen target that the drafter imitates.
            batch: Some of the training examples.
            step: The optimisation step.
            settings: Settings of `kerv train drafter`: `drafter` for the drafter, `train` for the optimisation.
        """

    @abstractmethod
    def validate(self, network: Any, target: Any, held_out: Any, settings: Any) -> Metrics:
        """Return metrics of a network on held-out examples. The best weights are those with the highest `score`.

        `settings` are those of `loss`.
        """

    @classmethod
    @abstractmethod
    def proposer(cls, settings: Any, context: Context) -> Proposer:
        """Return the proposer that drafts with the network `context.artifact(kind)`."""

    def load(self, path: Path, artifacts: Artifacts) -> Any:
        """Load the network with frozen weights, on the target's device and in the target's number format."""
        from kerv_cli.targets.compact.program import load_compiled

        target, description = artifacts.target, self.checked(path, artifacts.description)
        settings = read(self.settings, description.settings, f"the {self.noun}'s settings", tolerant=True)
        return load_compiled(self.network(settings, target), path, self.kind, target.device, target.dtype)

    def digest(self, path: Path, description: DrafterDescription) -> str:
        return description.sha256

    def described(self, file: Path) -> DrafterDescription:
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
        """Write the weights and the description, and return the hash of the weights.

        Args:
            stored: Number format of the weights on disk: `float32`, `float16` or `int8`.
            fields: Further fields of the description, if this kind of drafter has any.
        """
        shared = {"target": made_for.sha256, "actions": made_for.actions.as_dict(), "provenance": dict(provenance)}
        chunk = {} if self.any_chunk else {"chunk": made_for.chunk}
        return checkpoint.save_module(path, self.kind, module, {**fields, **shared, **chunk}, stored)
