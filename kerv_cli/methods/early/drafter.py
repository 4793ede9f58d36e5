"""The early drafter: network, proposer, training and files (docs/methods.md §5, ours).

It drafts the whole chunk from the encoded prompt, before the target's trunk runs. A residual network turns the pooled
prompt into a few features per token, and one head turns features into bins. A chunk costs one small pass.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.base.registry import NoSettings
from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.engine.transfer import read
from kerv_cli.methods.context import Context
from kerv_cli.methods.drafters import Metrics, TrainableDrafter, Training
from kerv_cli.methods.early import EarlySettings
from kerv_cli.targets.compact.packable import Packable
from kerv_cli.targets.compact.program import Program
from kerv_cli.targets.losses import soft_labels, token_loss
from kerv_cli.targets.observations import Rows, observations_of, prompts_of, split, steps_of
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

SURE = 0.05
"""Estimate from which fallback sources do not draft: 89 % of such chunks were accepted whole (mt10-vision, r = 9)."""


class Block(nn.Module):
    """Residual SwiGLU block, pre-norm; in a comparison better than a plain MLP block with as many weights."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.RMSNorm(width, eps=1e-5)
        self.gate_up = nn.Linear(width, 2 * width)
        self.down = nn.Linear(width, width)
        nn.init.zeros_(self.down.weight)

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, W) of (B, W)."""
        gate, up = self.gate_up(self.norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)


class EarlyNetwork(Packable):
    """A residual network from the pooled prompt (F,) to the logits (N, V) of all tokens."""

    mean: Tensor
    scale: Tensor
    strict: Tensor
    packed: Program | None

    def __init__(self, settings: EarlySettings, actions: ActionSpace, chunk: int, features: int) -> None:
        super().__init__()
        self.settings, self.actions, self.chunk = settings, actions, chunk
        self.tokens = chunk * actions.dofs
        # prompt embeddings differ in size by orders of magnitude
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        self.register_buffer("strict", torch.from_numpy(actions.strict_tokens(self.tokens)), persistent=False)
        self.enter = nn.Linear(features, settings.width)
        self.blocks = nn.ModuleList(Block(settings.width) for _ in range(settings.layers))
        self.norm = nn.RMSNorm(settings.width, eps=1e-5)
        self.spread = nn.Linear(settings.width, self.tokens * settings.rank)
        self.head = nn.Linear(settings.rank, actions.tokens)

    def pack_weights(self) -> Program | None:
        """Return the compiled network; None in other formats than float32."""
        return Program(self.logits, (1, len(self.mean))) if self.mean.dtype == torch.float32 else None

    def standardise(self, features: Tensor) -> None:
        """Take mean and spread from the training features (n, F)."""
        self.mean.copy_(features.float().mean(0))
        self.scale.copy_(1.0 / features.float().std(0).clamp_min(1e-3))

    def forward(self, features: Tensor) -> Tensor:
        """Return the logits (B, N, V) of pooled prompts (B, F)."""
        return self.packed(features)[0] if self.packed and self.is_packed(features) else self.logits(features)

    def logits(self, features: Tensor) -> Tensor:
        """Compute `forward` by the modules."""
        x = self.enter((features - self.mean) * self.scale)
        for block in self.blocks:
            x = block(x)
        return self.head(self.spread(self.norm(x)).unflatten(-1, (self.tokens, self.settings.rank)))

    @torch.inference_mode()
    def draft(self, features: Tensor, radius: int) -> Tensor:
        """Return N tokens and the odds that all are accepted, (B, N + 1) float64, without waiting for the device.

        Args:
            features: Pooled prompts (B, F).
            radius: r in bins, see `choose`.
        """
        return self.chosen(self(features.to(self.head.weight.dtype)), radius)

    def chosen(self, logits: Tensor, radius: int) -> Tensor:
        """Return the result of `draft` from logits (B, N, V)."""
        tokens, odds = choose_with_odds(logits, radius, self.strict)
        return torch.cat([tokens.double(), odds.double()[:, None]], -1)


def choose(logits: Tensor, radius: int, strict: Tensor) -> Tensor:
    """Return the tokens (B, N) that are most likely to be accepted at a radius.

    The most probable bin need not have the most probability within ±radius. Many bins tie within a wide radius. The
    probabilities within a third of it and of the bin itself break the tie, so that accepted tokens stay near the
    target's. A strict token must equal the target's: it is the most probable one.

    Args:
        logits: (B, N, V).
        radius: In bins.
        strict: (N,) bool.
    """
    return logits.argmax(-1) if not radius else choose_with_odds(logits, radius, strict)[0]


def choose_with_odds(logits: Tensor, radius: int, strict: Tensor) -> tuple[Tensor, Tensor]:
    """Return the tokens of `choose` and the odds (B,) that all of them are accepted.

    The odds assume independent tokens, and training on soft labels keeps them low. Compare chunks by them; they are no
    probabilities.
    """
    probability = logits.float().softmax(-1)
    below = F.pad(probability, (radius + 1, radius)).cumsum(-1)  # one sum for both radii
    near, best = _between(below, radius, radius, logits.shape[-1]), logits.argmax(-1)
    tokens = best
    if radius:
        score = near + 0.1 * _between(below, radius, radius // 3, logits.shape[-1]) + 0.05 * probability
        tokens = torch.where(strict, best, score.argmax(-1))
    exact, within = (of.gather(-1, tokens[..., None])[..., 0] for of in (probability, near))
    return tokens, torch.where(strict, exact, within).prod(-1)


def _between(below: Tensor, pad: int, radius: int, bins: int) -> Tensor:
    """Return the probability within `radius` ≤ pad bins (…, V), from the cumulated one (…, V + 2 pad + 1)."""
    return below[..., pad + radius + 1 :][..., :bins] - below[..., pad - radius :][..., :bins]


def radius_of(chunks: Sequence[Chunk]) -> int:
    """Return r of chunks whose limits are equal."""
    return max(chunks[0].limits, default=0)


class EarlyProposer(ChainProposer):
    """The early drafter's chunk (docs/methods.md §5), drafted once per observation."""

    name = "early"

    def __init__(self, early: EarlyNetwork, target: ReadableTarget) -> None:
        self.early, self.target = early, target
        self._drafted: tuple[Chunk, list[int], float] | None = None  # the chunk, its draft and the odds

    def drafted(self, chunk: Chunk) -> tuple[list[int], float]:
        """Return the draft of the chunk's N tokens and the odds that all are accepted."""
        if self._drafted is None or self._drafted[0] is not chunk:
            numbers = read(self._rows([chunk])[0])[0]
            self._drafted = chunk, numbers[:-1].astype(np.int64).tolist(), float(numbers[-1])
        return self._drafted[1:]

    def _rows(self, chunks: Sequence[Chunk]) -> Tensor:
        """Return the drafts (B, N + 1) of chunks whose limits are equal, as `EarlyNetwork.draft`."""
        features = torch.cat([self.target.pooled(chunk.prompt) for chunk in chunks])
        return self.early.draft(features, radius_of(chunks))

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return the drafted tokens after the committed ones."""
        return [self.drafted(chunk)[0][len(chunk.tokens) : chunk.size][:depth]]

    def tokens_of(self, chunks: Sequence[Chunk]) -> list[list[int]]:
        """Return the drafts of chunks whose limits are equal."""
        return self._rows(chunks)[:, :-1].long().tolist()

    def is_sure(self, chunk: Chunk) -> bool:
        """Return whether the odds of the whole chunk reach SURE."""
        return self.drafted(chunk)[1] >= SURE


@dataclass(frozen=True)
class Decodes(Rows):
    """The target's greedy decodes of n observations, in the order of episodes."""

    tokens: Tensor  # (n, N) int64
    episodes: Tensor  # (n,) int64
    perturbed: Tensor  # (n,) bool, the observation's episode was executed with noise


@dataclass(frozen=True)
class EarlyExamples(Decodes):
    """What an early drafter learns from."""

    features: Tensor  # (n, F) float16, pooled prompts


class EarlyDrafter(TrainableDrafter):
    """The early drafter. It learns the target's greedy decodes; neighbouring bins share probability."""

    kind, noun = "early", "early drafter"
    settings: type[Any] = EarlySettings

    def network(self, settings: Any, target: Any) -> nn.Module:
        """Return a fresh network for the target's action space, H and F."""
        return EarlyNetwork(settings, target.actions, target.chunk, target.pooled_width)

    @classmethod
    def proposer(cls, settings: NoSettings, context: Context) -> EarlyProposer:
        """Build proposer=early."""
        return EarlyProposer(context.artifact(cls.kind), context.target)

    @torch.inference_mode()
    def examples(
        self, target: Any, dataset: DemoDataset, settings: Any, held_out: float, progress: OnProgress
    ) -> tuple[Decodes, Decodes]:
        """Return the target's decodes of about `settings.samples` observations, spread evenly over all episodes.

        Prompts are pooled right after encoding, so that neither frames nor prompts stay in memory.

        Raises:
            CheckpointError: The frames are not of the size that the target takes.
        """
        sees = bool(target.cameras)
        share, columns = share_of(dataset, settings.samples, sees), list[dict[str, Tensor]]()

        def observations() -> Iterator[Observation]:
            for index in range(len(dataset.episodes)):
                episode = dataset.load(index)
                steps = evenly(steps_of(episode, sees), share)
                columns.append(columns_of(episode, index, len(steps)))
                yield from observations_of(target, episode, steps, dataset.manifest.observation)
                progress(index + 1, len(dataset.episodes))

        features, tokens = [], []
        for prompt in prompts_of(target, observations()):
            features.append(target.pooled(prompt).half().cpu())
            tokens.append(greedy(target, prompt)[0].cpu())
        joined = {name: torch.cat([column[name] for column in columns]) for name in columns[0]}
        return split(EarlyExamples(features=torch.cat(features), tokens=torch.cat(tokens), **joined), held_out)

    def prepare(self, network: Any, examples: Any) -> None:
        """Take mean and spread of the features."""
        network.standardise(examples.features)

    def outputs(self, training: Training, module: Any, examples: Any, indices: Tensor) -> tuple[Tensor, ...]:
        """Return the module's outputs for the examples `indices` (B,): first of all its logits (B, N, V)."""
        return (module(examples.features[indices].to(training.target.device).float()),)

    def token_loss(self, training: Training, logits: Tensor, indices: Tensor) -> Tensor:
        """Return the cross-entropy of logits (B, N, V) with the target's softened tokens."""
        device = training.target.device
        labels = _labels(training.target.actions.tokens, training.settings.train.label_sigma, device)
        return token_loss(logits, training.examples.tokens[indices].to(device), labels)

    def loss(self, training: Training, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Return the token loss."""
        logits = self.outputs(training, training.module, training.examples, indices)[0]
        loss = self.token_loss(training, logits, indices)
        return loss, {"token_loss": float(loss.detach())}

    def validate(self, training: Training, module: Any) -> Metrics:
        """Compare drafts of held-out observations with the target; plain and perturbed episodes count alike."""
        held_out, actions = training.held_out, training.target.actions
        batches = (self.outputs(training, module, held_out, i) for i in torch.arange(len(held_out)).split(256))
        logits, *rest = (torch.cat(parts).cpu() for parts in zip(*batches, strict=True))
        metrics = measure(logits, held_out, torch.from_numpy(actions.strict_tokens(logits.shape[1])))
        score = metrics["accepted_r9"] + metrics["accepted_strict"]
        return {"score": score, **metrics, **self.further_metrics(training, *rest)}

    def further_metrics(self, training: Training, *outputs: Tensor) -> Metrics:
        """Return metrics of the outputs after the logits."""
        return {}


@functools.lru_cache(maxsize=1)
def _labels(tokens: int, sigma: float, device: torch.device) -> Tensor:
    return soft_labels(tokens, sigma).to(device)


def share_of(dataset: DemoDataset, samples: int, sees: bool) -> float:
    """Return the share of the observations that makes about `samples`. A target that sees needs those with a frame."""
    stride = int(dataset.manifest.config["frame_stride"]) if sees else 1
    return min(1.0, samples * stride / sum(e.steps for e in dataset.episodes))


def evenly(steps: np.ndarray, share: float) -> np.ndarray:
    """Return an evenly spread share of the steps (n,); the first is always one of them."""
    order = np.arange(len(steps))
    return steps[np.ceil((order + 1) * share - 1e-9) > np.ceil(order * share - 1e-9)]


def columns_of(episode: DemoEpisode, index: int, count: int) -> dict[str, Tensor]:
    """Return the fields of `Decodes` that need no target, for `count` control steps of one episode."""
    return {"episodes": torch.full((count,), index), "perturbed": torch.full((count,), episode.perturbed)}


def measure(logits: Tensor, examples: Decodes, strict: Tensor) -> Metrics:
    """Return accepted tokens and the share of whole chunks at every radius, and the token accuracy.

    Accepted is the longest prefix within the radius of the target's tokens. That approximates relaxed acceptance, in
    which later target tokens depend on the accepted draft.

    Args:
        logits: (n, N, V) of the drafter.
        examples: n decodes of the target.
        strict: (N,) bool, tokens that must be equal.
    """
    kinds = [mask for mask in (examples.perturbed, ~examples.perturbed) if mask.any()]

    def balanced(values: Tensor) -> float:
        return float(torch.stack([values.float()[mask].mean() for mask in kinds]).mean())

    metrics: Metrics = {}
    for name, r in {"strict": 0, "r3": 3, "r9": 9}.items():
        right = (choose(logits, r, strict) - examples.tokens).abs() <= torch.where(strict, 0, r)
        accepted = right.long().cumprod(1).sum(1)
        metrics[f"accepted_{name}"] = balanced(accepted)
        metrics[f"whole_{name}"] = balanced(accepted == logits.shape[1])
    metrics["token_accuracy"] = balanced((logits.argmax(-1) == examples.tokens).float().mean(1))
    return metrics
