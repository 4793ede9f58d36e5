"""The scout: network, proposer and training (docs/methods.md §5.1, ours).

A scout is a drafter that reads the image itself, beside the hand and the instruction. It needs nothing that the target
computes. So chunks without verification never pay for the target's encoder, and a scout need not repeat an error of
the target's encoder. Its own vision encoder (stem) and its estimate of the positions of object and goal feed the
network of the early drafter.

Shapes: B observations, p numbers of proprioception, F features, K estimated positions, N tokens of a chunk, V bins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.registry import NoSettings
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.chunk import Chunk
from kerv_cli.methods.context import Context
from kerv_cli.methods.drafters import Decodes, Metrics
from kerv_cli.methods.early.drafter import EarlyDrafter, EarlyNetwork, EarlyProposer
from kerv_cli.methods.scout import ScoutSettings
from kerv_cli.targets.compact.features import VisionEncoder, hand_features, mlp, scene_features, scene_width
from kerv_cli.targets.compact.program import Compilable, Program
from kerv_cli.targets.compact.target import CompactTarget, Inputs
from kerv_cli.targets.losses import position_loss
from kerv_cli.targets.observations import BATCH, Observations, read_observations
from kerv_cli.worlds.demos.files import DemoEpisode


class ScoutNetwork(Compilable):
    """The network from an observation to the logits of a chunk (N tokens, V bins).

    It also estimates the positions of the task's K places, such as object and goal.
    """

    centre: Tensor
    compiled: Program | None

    def __init__(
        self,
        settings: ScoutSettings,
        actions: ActionSpace,
        observation: ObservationSpace,
        chunk: int,
        views: int,
        size: int,
        words: int,
    ) -> None:
        """Build the network.

        Args:
            settings: Shapes of the network.
            actions: The action space.
            observation: The observation space.
            chunk: Number of control steps per chunk.
            views: Number of camera views in the image, side by side.
            size: Width and height of a view, in pixels.
            words: Number of words in the target's vocabulary.
        """
        super().__init__()
        s = self.settings = settings
        self.observation, self.size = observation, size
        self.register_buffer("centre", torch.tensor(observation.centre), persistent=False)
        self.stems = nn.ModuleList(
            VisionEncoder(size, s.grid, s.keypoints, s.channels, s.cell_width, "instance") for _ in range(views)
        )
        self.cells = nn.Linear(s.cell_width, s.cell_features)
        self.words = nn.Embedding(words, s.word_width)
        p, places = len(observation.proprioception), len(observation.places)
        self.locate = mlp(2 * s.keypoints * views + p + s.word_width, 128, 64, 3 * places)
        of_views = (s.cell_width + s.grid**2 * s.cell_features) * views
        self.drafter = EarlyNetwork(s, actions, chunk, of_views + s.word_width + scene_width(observation))

    def forward(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """Return the logits (B, N, V), and the estimated positions of object and goal (B, K, 3), in metres."""
        given = self.views(inputs)
        if self.compiled is not None and self.runs_compiled(*given):
            logits, places = self.compiled(*given)
            return logits, places
        return self.network(*given)

    def views(self, inputs: Inputs) -> list[Tensor]:
        """Encode the images and the instructions of observations.

        Returns:
            The proprioception (B, p), the mean word embedding of the instruction (B, word width), and two tensors for
            each camera view: features of the grid cells (B, cells, cell width), and image points (B, 2 · keypoints).
        """
        assert inputs.images is not None
        found = [inputs.proprioception, self.words(inputs.words).mean(1)]
        for stem, image in zip(self.stems, inputs.images.split(self.size, -1), strict=True):
            found += stem(image)
        return found

    def see(self, proprioception: Tensor, words: Tensor, *views: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the drafter's input features, and estimate the positions of the task's places (object, goal).

        Args:
            proprioception: (B, p) proprioception.
            words: (B, word width) mean word embedding of the instruction.
            views: For each camera view its features and its image points, as the method `views` returns them.

        Returns:
            Features (B, F), and the positions (B, K, 3) in metres of K places, such as object and goal.
        """
        cells: list[Tensor] = []
        for grid in views[::2]:
            cells += grid.mean(1), self.cells(grid).flatten(1)
        located = self.locate(torch.cat([*views[1::2], hand_features(proprioception, self.centre), words], -1))
        places = located.unflatten(-1, (-1, 3)) * 0.1 + self.centre
        scene = scene_features(proprioception, places, self.centre)
        return torch.cat([*cells, words, scene], -1), places

    def network(self, *given: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the result of `forward` from the results of `views`, with the PyTorch modules."""
        features, places = self.see(*given)
        return self.drafter.logits(features.to(self.drafter.head.weight.dtype)), places

    def new_program(self) -> Program:
        """Return the compiled network, without its vision encoders."""
        return Program(self.network, *self.shapes)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Shapes of the tensors that `views` returns for one observation."""
        s = self.settings
        of_view = (1, s.grid**2, s.cell_width), (1, 2 * s.keypoints)
        return [(1, len(self.observation.proprioception)), (1, s.word_width), *of_view * len(self.stems)]


class ScoutProposer(EarlyProposer):
    """Drafts chunks with the scout, once per observation. The target's encoder need not run."""

    name = "scout"

    def __init__(self, scout: ScoutNetwork, target: Any) -> None:
        self.scout, self.inputs = scout, target.inputs
        super().__init__(scout.drafter, target)

    def compile(self) -> Program | None:
        """Return a compiled program that computes `row` from a radius (1, 1) and the results of `ScoutNetwork.views`.

        Return None if the scout is not compiled.
        """
        scout = self.scout

        def row(radius: Tensor, *views: Tensor) -> Tensor:
            logits: Any = scout.network(*views)[0]
            chosen: Tensor = logits.choose(radius, scout.drafter.strict)
            return chosen

        return Program(row, (1, 1), *scout.shapes) if scout.compiled is not None else None

    @torch.inference_mode()
    def row(self, chunk: Chunk, radius: int) -> Tensor:
        """Draft the tokens of a chunk from its observation, for the acceptance `radius` in bins.

        Returns:
            (N + 1,): the N tokens, then the estimated probability that all of them are accepted.
        """
        assert chunk.observation is not None
        if self.compiled is not None:
            return self.compiled(torch.tensor([[radius]]), *self.scout.views(self.inputs(chunk.observation)))[0][0]
        return self.early.chosen(self.scout(self.inputs(chunk.observation))[0], radius)[0]


@dataclass(frozen=True)
class ScoutExamples(Observations, Decodes):
    """The n training examples of a scout: observations, and what the target decoded and estimated from them.

    The target decoded tokens, and estimated the positions of object and goal. The simulator's true positions are not
    used.
    """

    places: Tensor  # (n, K, 3) float32, positions estimated by the target, metres


class ScoutDrafter(EarlyDrafter):
    """The kind of artifact `scout`: a drafter with its own vision encoder, for targets with cameras.

    In the first `train.scene_steps` steps of the training, the scout learns only to estimate positions.
    """

    kind = noun = "scout"
    settings = ScoutSettings

    def network(self, settings: ScoutSettings, target: Any) -> ScoutNetwork:
        """Return a network with initial weights, for the target's camera views.

        Raises:
            CheckpointError: The target has no camera.
        """
        size, width, _ = check_sees(target).frame_shape
        shape = width // size, size, target.words.size
        return ScoutNetwork(settings, target.actions, target.observation, target.chunk, *shape)

    @classmethod
    def proposer(cls, settings: NoSettings, context: Context) -> ScoutProposer:
        """Build the part that the setting `proposer=scout` chooses."""
        return ScoutProposer(context.artifact(cls.kind), context.target)

    def decoded(
        self, target: Any, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace, columns: dict[str, Tensor]
    ) -> ScoutExamples:
        """Let the target decode observations of an episode, and return them as training examples.

        An example's labels are the target's tokens, and the target's estimates of the positions of object and goal.

        Raises:
            CheckpointError: The target has no camera, or the images have another size than the target takes.
        """
        settings, chosen = check_sees(target).settings, np.searchsorted(episode.frame_steps, steps)
        rows = read_observations(episode, settings, space, target.words, chosen)
        tokens, places = [], []
        for indices in torch.arange(len(rows)).split(BATCH):
            prompt, located = target.encode_batch(rows.where(indices).inputs(target.device))
            tokens.append(greedy(target, prompt)[0].cpu())
            places.append(located.float().cpu())
        return ScoutExamples(**(vars(rows) | columns), tokens=torch.cat(tokens), places=torch.cat(places))

    def prepare(self, network: Any, examples: Any) -> None:
        """Do nothing. The features cannot be standardised, because they change while the vision encoder is trained."""

    def outputs(self, network: Any, target: Any, batch: Any) -> tuple[Tensor, ...]:
        """Run the network on a batch of B examples. Return logits (B, N, V) and estimated positions (B, K, 3)."""
        return network(batch.inputs(target.device))

    def loss(self, network: Any, target: Any, batch: Any, step: int, settings: Any) -> tuple[Tensor, Metrics]:
        """Return the loss of a batch, and metrics to log.

        The loss is the token loss plus the weighted position loss. In the first `train.scene_steps` steps it is the
        position loss alone.
        """
        train, labels = settings.train, batch.places.to(target.device)
        if step < train.scene_steps:
            loss = position_loss(network.see(*network.views(batch.inputs(target.device)))[1], labels)
            return loss, {"position_loss": float(loss.detach())}
        logits, places = self.outputs(network, target, batch)
        token, position = self.token_loss(logits, target, batch, settings), position_loss(places, labels)
        metrics = {"token_loss": float(token.detach()), "position_loss": float(position.detach())}
        return token + train.scene_weight * position, metrics

    def further_metrics(self, target: Any, held_out: Any, *outputs: Tensor) -> Metrics:
        """Return the median error of each estimated position, in centimetres."""
        error = (outputs[0] - held_out.places).norm(dim=-1).median(0).values
        names = [place.name.replace(" ", "_") for place in target.observation.places]
        return {f"{name}_error_cm": 100 * float(e) for name, e in zip(names, error, strict=True)}


def check_sees(target: Any) -> CompactTarget:
    """Return the target, if it has a camera and estimates positions.

    Raises:
        CheckpointError: The target has no camera, or estimates no positions.
    """
    if not isinstance(target, CompactTarget) or not getattr(target, "cameras", ()):
        raise CheckpointError(
            "a scout needs a target with a camera that locates object and goal (policy=vision); this one has none"
        )
    return target
