"""Training the early drafter on the frozen target's own greedy decodes (docs/methods.md §5).

Prompts are pooled to features right after encoding, so that neither frames nor prompts of the data set stay in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.methods.early import EarlySettings
from kerv_cli.methods.early.drafter import EarlyArtifact, EarlyDrafter, choose
from kerv_cli.targets.losses import soft_labels, token_loss
from kerv_cli.targets.observations import Rows, observations_of, prompts_of, split, steps_of
from kerv_cli.training.loop import Metrics
from kerv_cli.training.settings import TrainDrafterSettings, TrainSettings
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

RADII = {"strict": 0, "r3": 3, "r9": 9}


@dataclass(frozen=True)
class Decodes(Rows):
    """The target's greedy decodes of n observations, in episode order."""

    tokens: Tensor  # (n, N) int64
    episodes: Tensor  # (n,) int64
    perturbed: Tensor  # (n,) bool, the observation's episode was executed with noise


@dataclass(frozen=True)
class EarlySamples(Decodes):
    """What an early drafter learns from."""

    features: Tensor  # (n, F) float16, pooled prompts


@torch.inference_mode()
def teach_early(
    target: ReadableTarget,
    dataset: DemoDataset,
    settings: EarlySettings,
    on_progress: OnProgress = lambda done, total: None,
) -> EarlySamples:
    """The target's decodes of about `settings.samples` observations, spread evenly over all episodes.

    Raises:
        CheckpointError: a demonstration's frames are not of the size that the target takes.
    """
    share, columns = share_of(dataset, settings.samples, bool(target.cameras)), list[dict[str, Tensor]]()

    def observations() -> Iterator[Observation]:
        for index in range(len(dataset.episodes)):
            episode = dataset.load(index)
            steps = evenly(steps_of(episode, bool(target.cameras)), share)
            columns.append(columns_of(episode, index, len(steps)))
            yield from observations_of(target, episode, steps, dataset.manifest.observation)
            on_progress(index + 1, len(dataset.episodes))

    features, tokens = [], []
    for prompt in prompts_of(target, observations()):
        features.append(target.pooled(prompt).half().cpu())
        tokens.append(greedy(target, prompt)[0].cpu())
    joined = {name: torch.cat([column[name] for column in columns]) for name in columns[0]}
    return EarlySamples(features=torch.cat(features), tokens=torch.cat(tokens), **joined)


def share_of(dataset: DemoDataset, samples: int, framed: bool) -> float:
    """The share of the observations that makes about `samples`. framed: only those with a frame are observed."""
    stride = int(dataset.manifest.config["frame_stride"]) if framed else 1
    return min(1.0, samples * stride / sum(e.steps for e in dataset.episodes))


def evenly(steps: np.ndarray, share: float) -> np.ndarray:
    """An evenly spread share of the steps (n,); the first is always one of them."""
    order = np.arange(len(steps))
    return steps[np.ceil((order + 1) * share - 1e-9) > np.ceil(order * share - 1e-9)]


def columns_of(episode: DemoEpisode, index: int, count: int) -> dict[str, Tensor]:
    """The fields of `Decodes` that do not need the target, for `count` control steps of one episode."""
    return {"episodes": torch.full((count,), index), "perturbed": torch.full((count,), episode.perturbed)}


class EarlyDistillation:
    """Loss and validation of one run. The target's tokens are the labels; neighbouring bins share probability."""

    def __init__(self, module: Any, training: Any, held_out: Any, train: TrainSettings) -> None:
        """training, held_out: `EarlySamples`; of a scout `ScoutSamples`."""
        self.module, self.training, self.held_out, self.train = module, training, held_out, train
        drafter = self.drafter(module)
        self.device, self.strict = drafter.mean.device, drafter.strict.cpu()
        self.labels = soft_labels(drafter.actions.tokens, train.label_sigma).to(self.device)

    def __len__(self) -> int:
        return len(self.training)

    def drafter(self, module: Any) -> EarlyDrafter:
        """The network that drafts."""
        return module

    def outputs(self, module: Any, samples: Any, indices: Tensor) -> tuple[Tensor, ...]:
        """What the module says of the samples at `indices` (B,): first of all its logits (B, N, V)."""
        return (module(samples.features[indices].to(self.device).float()),)

    def token_loss(self, logits: Tensor, indices: Tensor) -> Tensor:
        """Cross-entropy of logits (B, N, V) with the softened tokens of the target at `indices` (B,)."""
        return token_loss(logits, self.training.tokens[indices].to(self.device), self.labels)

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """The token loss at `indices` (B,), and logged numbers."""
        loss = self.token_loss(self.outputs(self.module, self.training, indices)[0], indices)
        return loss, {"token_loss": float(loss.detach())}

    @torch.no_grad()
    def validate(self, module: nn.Module) -> Metrics:
        """Drafts of the held-out observations; plain and perturbed episodes count alike."""
        batches = (self.outputs(module, self.held_out, i) for i in torch.arange(len(self.held_out)).split(256))
        logits, *rest = (torch.cat(parts).cpu() for parts in zip(*batches, strict=True))
        metrics = measure(logits, self.held_out, self.strict)
        score = metrics["accepted_r9"] + metrics["accepted_strict"]
        return {"score": score, **metrics, **self.further_metrics(*rest)}

    def further_metrics(self, *outputs: Tensor) -> Metrics:
        """Metrics of the outputs behind the logits."""
        return {}


def accepted_tokens(drafts: Tensor, teacher: Tensor, r: int, strict: Tensor) -> Tensor:
    """drafts, teacher (n, N), strict (N,) bool -> (n,) length of the longest prefix within r bins of the teacher; the
    strict tokens must be equal. Approximates relaxed acceptance, in which later target tokens depend on the accepted
    draft."""
    limit = torch.where(strict, 0, r)
    return ((drafts - teacher).abs() <= limit).long().cumprod(1).sum(1)


def measure(logits: Tensor, samples: Decodes, strict: Tensor) -> Metrics:
    """logits (n, N, V), strict (N,) bool -> accepted tokens of N and the share of chunks accepted whole, at every
    radius; token accuracy."""
    kinds = [mask for mask in (samples.perturbed, ~samples.perturbed) if mask.any()]

    def balanced(values: Tensor) -> float:
        return float(torch.stack([values.float()[mask].mean() for mask in kinds]).mean())

    metrics: Metrics = {}
    for name, r in RADII.items():
        drafts = choose(logits, r, strict)
        accepted = accepted_tokens(drafts, samples.tokens, r, strict)
        metrics[f"accepted_{name}"] = balanced(accepted)
        metrics[f"whole_{name}"] = balanced(accepted == logits.shape[1])
    metrics["token_accuracy"] = balanced((logits.argmax(-1) == samples.tokens).float().mean(1))
    return metrics


class EarlyTraining:
    """`kerv train drafter drafter=early`."""

    artifact = EarlyArtifact()

    def objective(
        self, target: ReadableTarget, dataset: DemoDataset, settings: TrainDrafterSettings, progress: OnProgress
    ) -> EarlyDistillation:
        """Decode the demonstrations with the target and make a fresh drafter."""
        samples = teach_early(target, dataset, settings.drafter, progress)
        training, held_out = split(samples, settings.train.held_out)
        torch.manual_seed(settings.train.seed)
        early = EarlyDrafter.beside(settings.drafter, target)
        early.standardise(training.features)
        return EarlyDistillation(early.to(target.device), training, held_out, settings.train)
