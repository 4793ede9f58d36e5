"""Training the early drafter on the frozen target's own greedy decodes (docs/methods.md §5).

What it reads of an observation is pooled as soon as the target has encoded it, so that neither frames nor prompts of a
whole data set are kept. The history it is shown is what the demonstration *executed*, noise included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.drafting.early import EarlyDrafter, choose, padded
from kerv_cli.environments.demos.dataset import DemoDataset
from kerv_cli.environments.demos.episode_file import DemoEpisode
from kerv_cli.errors import CheckpointError
from kerv_cli.settings import DrafterSettings, TrainSettings
from kerv_cli.targets.compact.target import CompactTarget, Inputs
from kerv_cli.training.distillation import greedy
from kerv_cli.training.imitation import held_out_of, instruction_of, observed, soft_labels, token_loss
from kerv_cli.training.loop import Job, Metrics

BATCH = 64  # observations that the teacher decodes at once
RADII = {"strict": 0, "r3": 3, "r9": 9}


@dataclass(frozen=True)
class EarlySamples:
    """The target's greedy decodes of n observations, in episode order."""

    features: Tensor  # (n, F) float16, pooled prompts
    history: Tensor  # (n, h, D) float32, the last executed actions, normalised, oldest first
    known: Tensor  # (n, h) float32, 0 where the episode had not begun yet
    tokens: Tensor  # (n, N) int64
    episodes: Tensor  # (n,) int64
    perturbed: Tensor  # (n,) bool, the observation's episode was executed with noise

    def __len__(self) -> int:
        return len(self.tokens)

    def where(self, mask: Tensor) -> EarlySamples:
        """The samples where mask (n,) bool is set."""
        return EarlySamples(*(getattr(self, f.name)[mask] for f in fields(self)))

    def split(self, share: float) -> tuple[EarlySamples, EarlySamples]:
        """(training, held out): the same episodes as `imitation.split`, which the target was not trained on either."""
        held = held_out_of(self.episodes, share)
        return self.where(~held), self.where(held)


@dataclass(frozen=True)
class Observations:
    """Some steps of one episode."""

    inputs: Inputs
    history: np.ndarray  # (n, h, D)
    known: np.ndarray  # (n, h)
    episode: int
    perturbed: bool

    def __len__(self) -> int:
        return len(self.known)


@torch.inference_mode()
def teach_early(
    target: CompactTarget,
    dataset: DemoDataset,
    settings: DrafterSettings,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> EarlySamples:
    """The teacher's decodes of about `settings.samples` observations, spread evenly over all episodes.

    Raises:
        CheckpointError: a demonstration's frames are not of the size that the target takes.
    """
    stride = int(dataset.manifest.config["frame_stride"]) if target.cameras else 1
    share = min(1.0, settings.samples * stride / sum(e.steps for e in dataset.episodes))
    parts: list[EarlySamples] = []
    waiting: list[Observations] = []
    for index in range(len(dataset.episodes)):
        waiting.append(observations(target, dataset.load(index), index, share, settings.history))
        if sum(map(len, waiting)) >= BATCH or index + 1 == len(dataset.episodes):
            parts.append(decode(target, waiting))
            waiting = []
        on_progress(index + 1, len(dataset.episodes))
    return EarlySamples(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(EarlySamples)))


def observations(target: CompactTarget, episode: DemoEpisode, index: int, share: float, history: int) -> Observations:
    """The share of the episode's observations, evenly spread, the first always."""
    frames, size = episode.frames, target.settings.image_size
    steps = episode.frame_steps if target.cameras else np.arange(episode.steps)
    if target.cameras and frames.shape[1] != size:
        raise CheckpointError(f"the demonstrations' frames have {frames.shape[1]} pixels, the target takes {size}")
    order = np.arange(len(steps))
    chosen = np.flatnonzero(np.ceil((order + 1) * share - 1e-9) > np.ceil(order * share - 1e-9))
    executed = target.actions.normalise(episode.executed)
    shown = [padded(executed[:t], history, target.actions.dofs) for t in steps[chosen]]
    images = torch.from_numpy(frames[chosen]).permute(0, 3, 1, 2) if target.cameras else None
    words = target.words_of(instruction_of(episode.task)).repeat(len(chosen), 1)
    felt, states = (torch.from_numpy(x).float() for x in observed(episode, steps[chosen], target.observation))
    inputs = Inputs(images, felt, states, words)
    actions, known = (np.stack(x) for x in zip(*shown, strict=True))
    return Observations(inputs, actions, known, index, episode.perturbed)


def decode(target: CompactTarget, waiting: Sequence[Observations]) -> EarlySamples:
    """The teacher on some episodes' observations."""
    counts = torch.tensor([len(o) for o in waiting])
    inputs = [o.inputs for o in waiting]
    felt, states, words = (torch.cat([getattr(i, n) for i in inputs]) for n in ("proprioception", "states", "words"))
    images = torch.cat([i.images for i in inputs if i.images is not None]) if target.cameras else None
    features, tokens = [], []
    for some in torch.arange(len(states)).split(BATCH):
        seen = images[some].to(target.device) if images is not None else None
        batch = Inputs(seen, *(x[some].to(target.device) for x in (felt, states, words)))
        prompt, _ = target.encode_batch(batch)
        features.append(target.pooled(prompt).half().cpu())
        tokens.append(greedy(target, prompt)[0].cpu())
    return EarlySamples(
        features=torch.cat(features),
        history=torch.from_numpy(np.concatenate([o.history for o in waiting])),
        known=torch.from_numpy(np.concatenate([o.known for o in waiting])),
        tokens=torch.cat(tokens),
        episodes=torch.tensor([o.episode for o in waiting]).repeat_interleave(counts),
        perturbed=torch.tensor([o.perturbed for o in waiting]).repeat_interleave(counts),
    )


class EarlyDistillation:
    """Loss and validation of one run. The teacher's tokens are the labels, neighbouring bins share probability."""

    def __init__(
        self, early: EarlyDrafter, training: EarlySamples, held_out: EarlySamples, train: TrainSettings
    ) -> None:
        self.early, self.training, self.held_out = early, training, held_out
        self.device = early.mean.device
        self.labels = soft_labels(early.actions.tokens, train.label_sigma).to(self.device)

    def logits(self, early: EarlyDrafter, samples: EarlySamples, indices: Tensor) -> Tensor:
        """(B, N, V) of the samples at `indices` (B,)."""
        given = (samples.features, samples.history, samples.known)
        return early(*(x[indices].to(self.device).float() for x in given))

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Cross-entropy of a batch."""
        logits = self.logits(self.early, self.training, indices)
        loss = token_loss(logits, self.training.tokens[indices].to(self.device), self.labels)
        return loss, {"token_loss": float(loss.detach())}

    @torch.no_grad()
    def validate(self, module: nn.Module) -> Metrics:
        """Drafts of the held-out observations; plain and perturbed episodes count alike."""
        assert isinstance(module, EarlyDrafter)
        indices = torch.arange(len(self.held_out))
        logits = torch.cat([self.logits(module, self.held_out, i).cpu() for i in indices.split(512)])
        metrics = measure(logits, self.held_out, module.strict.cpu())
        return {"score": metrics["accepted_r9"] + metrics["accepted_strict"], **metrics}


def accepted_tokens(drafts: Tensor, teacher: Tensor, r: int, strict: Tensor) -> Tensor:
    """drafts, teacher (n, N), strict (N,) bool -> (n,) length of the longest prefix within r bins of the teacher; the
    strict tokens must be equal. A proxy of relaxed acceptance: there the target's token is conditioned on the draft."""
    limit = torch.where(strict, 0, r)
    return ((drafts - teacher).abs() <= limit).long().cumprod(1).sum(1)


def measure(logits: Tensor, samples: EarlySamples, strict: Tensor) -> Metrics:
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


def early_job(run: EarlyDistillation, save: Callable[[nn.Module, Metrics], None]) -> Job:
    """The run as the shared loop takes it."""
    return Job(run.early, len(run.training), run.loss, run.validate, save)
