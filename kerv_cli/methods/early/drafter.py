"""The early drafter and the scout: networks, proposers and training (docs/methods.md §5, §5.1, ours).

The early drafter drafts a whole chunk from the encoded prompt, before the target's trunk runs. A residual network turns
the pooled prompt into a few features per token, and one head turns the features into logits over the bins. So a chunk
costs one small forward pass.

The scout reads the image itself, beside the hand and the instruction. It needs nothing that the target computes. So
chunks without verification never pay for the target's encoder, and a scout need not repeat an error of the target's
encoder. Its own vision encoder (stem) and its estimate of the positions of object and goal feed the network of the
early drafter.

Shapes: B prompts or observations, F features, p numbers of proprioception, K estimated positions, N tokens of a chunk,
V bins, which are the possible tokens.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.registry import NoSettings
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.protocol import JoinsDrafters, ReadableTarget
from kerv_cli.engine.transfer import read
from kerv_cli.methods.context import Context
from kerv_cli.methods.drafters import Decodes, Metrics, TrainableDrafter
from kerv_cli.methods.early import EarlySettings, ScoutSettings
from kerv_cli.targets.compact.features import VisionEncoder, hand_features, mlp, scene_features, scene_width
from kerv_cli.targets.compact.program import Compilable, Program
from kerv_cli.targets.compact.target import CompactTarget, Inputs
from kerv_cli.targets.losses import labels_of, position_loss, token_loss, within_chunk
from kerv_cli.targets.observations import (
    BATCH,
    Observations,
    observations_of,
    prompts_of,
    read_observations,
)
from kerv_cli.worlds.demos.files import DemoEpisode

SURE = 0.05
"""The early drafter is sure of a chunk if it estimates at least this probability that all tokens are accepted.

The estimate is lower than the true probability: 89 % of such chunks were accepted whole (mt10-vision, radius 9).
"""


class Block(nn.Module):
    """Residual SwiGLU block with a norm before it. A plain MLP block with as many weights was worse."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.RMSNorm(width, eps=1e-5)
        self.gate_up = nn.Linear(width, 2 * width)
        self.down = nn.Linear(width, width)
        nn.init.zeros_(self.down.weight)

    def forward(self, x: Tensor) -> Tensor:
        """Map features (B, W) to features (B, W)."""
        gate, up = self.gate_up(self.norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)


class EarlyNetwork(Compilable):
    """A residual network from the pooled prompt (F features) to the logits of a chunk (N tokens, V bins)."""

    mean: Tensor  # (F,) mean of the training features
    scale: Tensor  # (F,) 1 / standard deviation of the training features
    strict: Tensor  # (N,) bool, tokens that must equal the target's, such as the gripper's
    compiled: Program | None

    def __init__(self, settings: EarlySettings, actions: ActionSpace, chunk: int, features: int) -> None:
        super().__init__()
        self.settings, self.actions, self.chunk = settings, actions, chunk
        self.tokens = actions.longest(chunk)
        # the prompt's features differ in size by orders of magnitude
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        self.register_buffer("strict", torch.from_numpy(actions.strict_tokens(self.tokens)), persistent=False)
        self.enter = nn.Linear(features, settings.width)
        self.blocks = nn.ModuleList(Block(settings.width) for _ in range(settings.layers))
        self.norm = nn.RMSNorm(settings.width, eps=1e-5)
        self.spread = nn.Linear(settings.width, self.tokens * settings.rank)
        self.head = nn.Linear(settings.rank, actions.tokens)

    def new_program(self) -> Program:
        """Return the compiled network."""
        return Program(self.logits, (1, len(self.mean)))

    def standardise(self, features: Tensor) -> None:
        """Set the mean and the scale by which inputs are standardised, from the training features (n, F)."""
        self.mean.copy_(features.float().mean(0))
        self.scale.copy_(1.0 / features.float().std(0).clamp_min(1e-3))

    def forward(self, features: Tensor) -> Tensor:
        """Return the logits (B, N, V) for pooled prompts (B, F), by the compiled network if there is one."""
        return self.compiled(features)[0] if self.compiled and self.runs_compiled(features) else self.logits(features)

    def logits(self, features: Tensor) -> Tensor:
        """Return the logits (B, N, V) for pooled prompts (B, F), by the PyTorch modules."""
        x = self.enter((features - self.mean) * self.scale)
        for block in self.blocks:
            x = block(x)
        return self.head(self.spread(self.norm(x)).unflatten(-1, (self.tokens, self.settings.rank)))

    @torch.inference_mode()
    def draft(self, features: Tensor, radius: int) -> Tensor:
        """Draft chunks. The result stays on the device, so the CPU need not wait for a GPU.

        Args:
            features: (B, F) pooled prompts.
            radius: Acceptance radius, in bins.

        Returns:
            (B, N + 1) float64: the N tokens, then the estimated probability that all of them are accepted.
        """
        return self.chosen(self(features.to(self.head.weight.dtype)), radius)

    def chosen(self, logits: Tensor, radius: int) -> Tensor:
        """Choose the tokens of chunks from logits.

        Args:
            logits: (B, N, V).
            radius: Acceptance radius, in bins.

        Returns:
            (B, N + 1) float64: the N tokens, then the estimated probability that all of them are accepted.
        """
        tokens, odds = choose(logits, radius, self.strict)
        return torch.cat([tokens.double(), odds.double()[:, None]], -1)


def choose(logits: Tensor, radius: int, strict: Tensor) -> tuple[Tensor, Tensor]:
    """Choose the tokens that are most likely to be accepted, and estimate the probability that all are accepted.

    A token is accepted if the target's token is at most `radius` bins away. So the best bin is the bin with the most
    probability in this range around it. The best bin need not be the most probable bin. If several bins are about
    equally good, the bin with more probability close to it wins, because it is likely nearer to the target's token. For
    a strict token the most probable bin is chosen.

    The estimate treats tokens as independent, and training on soft labels makes the estimate too low. Use it only to
    compare chunks.

    Args:
        logits: (B, N, V).
        radius: Acceptance radius, in bins.
        strict: (N,) bool, whether the token must equal the target's, as the gripper's must.

    Returns:
        The tokens (B, N), and the estimates (B,).
    """
    probability = logits.float().softmax(-1)
    below = F.pad(probability, (radius + 1, radius)).cumsum(-1)  # one cumulative sum for both radii
    near, best = _between(below, radius, radius, logits.shape[-1]), logits.argmax(-1)
    tokens = best
    if radius:
        score = near + 0.1 * _between(below, radius, radius // 3, logits.shape[-1]) + 0.05 * probability
        tokens = torch.where(strict, best, score.argmax(-1))
    exact, within = (of.gather(-1, tokens[..., None])[..., 0] for of in (probability, near))
    return tokens, torch.where(strict, exact, within).prod(-1)


def _between(below: Tensor, pad: int, radius: int, bins: int) -> Tensor:
    """Return, for each bin, the summed probability of the bins that are at most `radius` bins away.

    Args:
        below: (…, V + 2 pad + 1) cumulative probability over the bins, padded on both sides.
        pad: Padding of `below`, at least `radius`.
        radius: Acceptance radius, in bins.
        bins: Number V of bins.

    Returns:
        (…, V) summed probabilities.
    """
    return below[..., pad + radius + 1 :][..., :bins] - below[..., pad - radius :][..., :bins]


class EarlyProposer(ChainProposer):
    """Drafts chunks with the early drafter (docs/methods.md §5), once per observation."""

    name = "early"

    def __init__(self, early: EarlyNetwork, target: ReadableTarget) -> None:
        self.early, self.target = early, target
        self.compiled = self.compile()
        self._drafted: tuple[Chunk, list[int], float] | None = None  # the last chunk, its draft, and the estimate

    def compile(self) -> Program | None:
        """Return a compiled program that computes the result of `row` from a radius (1, 1) and a prompt.

        Return None if the drafter is not compiled, or if drafter and target cannot be compiled together.
        """
        early: Any = self.early
        target: Any = self.target

        def row(radius: Tensor, prompt: Tensor) -> Any:
            return early.logits(target.pooled(prompt)).choose(radius, early.strict)

        joins = isinstance(target, JoinsDrafters) and isinstance(getattr(early, "compiled", None), Program)
        return target.join(row, (1, 1), (1, target.max_prompt, target.width)) if joins else None

    def drafted(self, chunk: Chunk) -> tuple[list[int], float]:
        """Return the draft of the chunk's N tokens, and the estimated probability that all are accepted."""
        if self._drafted is None or self._drafted[0] is not chunk:
            numbers = read(self.row(chunk, max(chunk.limits, default=0)))[0]
            self._drafted = chunk, numbers[:-1].astype(np.int64).tolist(), float(numbers[-1])
        return self._drafted[1:]

    def row(self, chunk: Chunk, radius: int) -> Tensor:
        """Draft the tokens of a chunk that are most likely to be accepted with this acceptance `radius`, in bins.

        Returns:
            (N + 1,): the N tokens, then the estimated probability that all of them are accepted.
        """
        if self.compiled is not None:
            return self.compiled(torch.tensor([[radius]]), chunk.target.prompt)[0][0]
        return self.early.draft(self.target.pooled(chunk.target.prompt), radius)[0]

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return one chain: up to `depth` drafted tokens after the chunk's committed tokens."""
        return [self.drafted(chunk)[0][len(chunk.tokens) : chunk.size][:depth]]

    def is_sure(self, chunk: Chunk) -> bool:
        """Return whether the estimated probability that the whole chunk is accepted is at least SURE."""
        return self.drafted(chunk)[1] >= SURE


@dataclass(frozen=True)
class EarlyExamples(Decodes):
    """The n training examples of an early drafter: pooled prompts, and the target's tokens."""

    features: Tensor  # (n, F) float16, pooled prompts


class EarlyDrafter(TrainableDrafter):
    """Early drafters, which are artifacts of the kind `early`.

    They learn the target's greedy tokens, with labels spread over neighbouring bins.
    """

    kind, noun = "early", "early drafter"
    settings: type[Any] = EarlySettings
    drafts_with: type[EarlyProposer] = EarlyProposer

    def network(self, settings: Any, target: Any) -> nn.Module:
        """Return a network with initial weights, for the target's action space, chunk length and pooled prompt."""
        return EarlyNetwork(settings, target.actions, target.chunk, target.pooled_width)

    @classmethod
    def proposer(cls, settings: NoSettings, context: Context) -> EarlyProposer:
        """Build the proposer that drafts with the policy's early drafter, or with its scout."""
        return cls.drafts_with(context.artifact(cls.kind), context.target)

    def decoded(
        self, target: Any, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace, columns: dict[str, Tensor]
    ) -> Decodes:
        """Decode observations of an episode. Keep only pooled prompts, because whole prompts would fill the memory.

        `TrainableDrafter.decoded` explains the arguments.
        """
        prompts = list(prompts_of(target, observations_of(target, episode, steps, space)))
        features = torch.cat([target.pooled(prompt).half().cpu() for prompt in prompts])
        tokens = torch.cat([greedy(target, prompt)[0].cpu() for prompt in prompts])
        return EarlyExamples(features=features, tokens=tokens, **columns)

    def prepare(self, network: Any, examples: Any) -> None:
        """Set the mean and the scale by which the network standardises its inputs, from the training examples."""
        network.standardise(examples.features)

    def outputs(self, network: Any, target: Any, batch: Any) -> tuple[Tensor, ...]:
        """Run the network on a batch of B examples. The first output is the logits (B, N, V)."""
        return (network(batch.features.to(target.device).float()),)

    def token_loss(self, logits: Tensor, target: Any, batch: Decodes, settings: Any) -> Tensor:
        """Return the cross-entropy of logits with soft labels, which spread each target token over neighbouring bins.

        Tokens after the end of a chunk are not counted.

        Args:
            logits: (B, N, V).
            target: The target.
            batch: The B training examples.
            settings: Settings of `kerv train drafter`.
        """
        labels = _labels(target.actions, settings.train.label_sigma, target.device)
        tokens = batch.tokens.to(target.device)
        end = target.actions.end
        return token_loss(logits, tokens, labels, None if end is None else within_chunk(tokens, end))

    def loss(self, network: Any, target: Any, batch: Any, step: int, settings: Any) -> tuple[Tensor, Metrics]:
        """Return the token loss of a batch, and metrics to log."""
        loss = self.token_loss(self.outputs(network, target, batch)[0], target, batch, settings)
        return loss, {"token_loss": float(loss.detach())}

    def validate(self, network: Any, target: Any, held_out: Any, settings: Any) -> Metrics:
        """Return metrics that compare drafts of held-out observations with the target's tokens.

        All perturbed episodes (executed with noise) together weigh as much as all other episodes together. The score is
        the mean number of accepted tokens with strict acceptance, plus the mean number with the acceptance radius 9.
        """
        chosen = torch.arange(len(held_out)).split(256)
        outputs = [self.outputs(network, target, held_out.where(indices)) for indices in chosen]
        logits, *rest = (torch.cat(parts).cpu() for parts in zip(*outputs, strict=True))
        strict = torch.from_numpy(target.actions.strict_tokens(logits.shape[1]))
        metrics = measure(logits, held_out, strict, target.actions.end)
        score = metrics["accepted_r9"] + metrics["accepted_strict"]
        return {"score": score, **metrics, **self.further_metrics(target, held_out, *rest)}

    def further_metrics(self, target: Any, held_out: Any, *outputs: Tensor) -> Metrics:
        """Return metrics of the network's outputs other than the logits. The early drafter has no such outputs."""
        return {}


@functools.lru_cache(maxsize=1)
def _labels(actions: ActionSpace, sigma: float, device: torch.device) -> Tensor:
    return labels_of(actions, sigma).to(device)


def measure(logits: Tensor, examples: Decodes, strict: Tensor, end: int | None = None) -> Metrics:
    """Estimate how many draft tokens would be accepted, at the acceptance radii 0, 3 and 9.

    A draft is accepted up to its first token that is not within the radius of the target's greedy token. This
    approximates relaxed acceptance, in which the target's later tokens depend on the accepted draft tokens.

    Args:
        logits: (n, N, V) of the drafter.
        examples: The target's greedy decodes of the same n observations.
        strict: (N,) bool, tokens that must equal the target's.
        end: The token that ends a chunk. Tokens after it are not counted. None if chunks have no such token.

    Returns:
        For each radius the mean number of accepted tokens, and the share of drafts of which all tokens are accepted.
        Also the token accuracy: the share of the drafter's most probable tokens that equal the target's. In each mean,
        perturbed episodes together weigh as much as all other episodes together.
    """
    kinds = [mask for mask in (examples.perturbed, ~examples.perturbed) if mask.any()]

    def balanced(values: Tensor) -> float:
        return float(torch.stack([values.float()[mask].mean() for mask in kinds]).mean())

    metrics: Metrics = {}
    counted = within_chunk(examples.tokens, end)
    sizes = counted.sum(1)
    for name, r in {"strict": 0, "r3": 3, "r9": 9}.items():
        right = (choose(logits, r, strict)[0] - examples.tokens).abs() <= torch.where(strict, 0, r)
        accepted = (right & counted).long().cumprod(1).sum(1)
        metrics[f"accepted_{name}"] = balanced(accepted)
        metrics[f"whole_{name}"] = balanced(accepted == sizes)
    right = (logits.argmax(-1) == examples.tokens) & counted
    metrics["token_accuracy"] = balanced(right.sum(1) / sizes)
    return metrics


# --- the scout (§5.1)


class ScoutNetwork(Compilable):
    """The network from an observation to the logits of a chunk (N tokens, V bins).

    It also estimates the positions of the task's K places, such as object and goal.
    """

    centre: Tensor
    compiled: Program | None

    def __init__(self, settings: ScoutSettings, target: Any, views: int) -> None:
        """Build the network.

        Args:
            settings: Shapes of the network.
            target: The target.
            views: Number of camera views in the image, side by side.
        """
        super().__init__()
        s = self.settings = settings
        observation = self.observation = target.observation
        size = self.size = target.frame_shape[0]
        self.register_buffer("centre", torch.tensor(observation.centre), persistent=False)
        self.stems = nn.ModuleList(
            VisionEncoder(size, s.grid, s.keypoints, s.channels, s.cell_width, "instance") for _ in range(views)
        )
        self.cells = nn.Linear(s.cell_width, s.cell_features)
        self.words = nn.Embedding(target.words.size, s.word_width)
        p, places = len(observation.proprioception), len(observation.places)
        self.locate = mlp(2 * s.keypoints * views + p + s.word_width, 128, 64, 3 * places)
        of_views = (s.cell_width + s.grid**2 * s.cell_features) * views
        features = of_views + s.word_width + scene_width(observation)
        self.drafter = EarlyNetwork(s, target.actions, target.chunk, features)

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
        """Return a compiled program that computes the result of `row`. Return None if the scout is not compiled.

        The program's inputs are a radius (1, 1) and the tensors that `ScoutNetwork.views` returns.
        """
        scout: Any = self.scout

        def row(radius: Tensor, *views: Tensor) -> Any:
            return scout.network(*views)[0].choose(radius, scout.drafter.strict)

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
    """The n training examples of a scout: observations, and the target's tokens and position estimates for them.

    The positions are those of object and goal. The simulator's true positions are not used.
    """

    places: Tensor  # (n, K, 3) float32, positions estimated by the target, metres


class ScoutDrafter(EarlyDrafter):
    """Scouts: drafters with their own vision encoder, for targets with cameras. They are artifacts of the kind `scout`.

    In the first `train.scene_steps` steps of the training, the scout learns only to estimate positions.
    """

    kind = noun = "scout"
    settings = ScoutSettings
    drafts_with = ScoutProposer

    def network(self, settings: ScoutSettings, target: Any) -> ScoutNetwork:
        """Return a network with initial weights, for the target's camera views.

        Raises:
            CheckpointError: The target has no camera.
        """
        height, width, _ = check_sees(target).frame_shape
        return ScoutNetwork(settings, target, width // height)

    def decoded(
        self, target: Any, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace, columns: dict[str, Tensor]
    ) -> ScoutExamples:
        """Let the target decode observations of an episode, and return them as training examples.

        An example's labels are the target's tokens, and the target's estimates of the positions of object and goal.
        `TrainableDrafter.decoded` explains the arguments.

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
