"""Behaviour cloning of the target on demonstrations.

One sample is one recorded control step: the observation, and the expert's next H clean actions as tokens. Validation
uses held-out *episodes*. Token accuracy does not show success (two policies with the same accuracy can differ by half
of the tasks), so closed-loop episodes are the score wherever they are asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.environments import spec_of
from kerv_cli.environments.demos.dataset import DemoDataset
from kerv_cli.environments.demos.episode_file import DemoEpisode
from kerv_cli.environments.metaworld.tasks import TASKS
from kerv_cli.errors import CheckpointError, UsageError
from kerv_cli.settings import TargetSettings, TrainSettings
from kerv_cli.spaces import DOF_NAMES, VOCABULARY, ActionTokenizer, values_of
from kerv_cli.targets.compact.target import GOAL, OBJECT, Inputs, Target
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.training.loop import Job, Metrics

WITHIN = 9  # bins; the share of tokens this close is reported (Spec-VLA's relaxed radius)


@dataclass(frozen=True)
class Samples:
    """Everything a policy is trained on, in memory; n samples in episode order."""

    frames: Tensor | None  # (n, s, s, 3) uint8
    states: Tensor  # (n, 39) float32
    chunks: Tensor  # (n, H, D) float32, the expert's clean actions, environment units
    words: Tensor  # (n, L) int64
    episodes: Tensor  # (n,) int64, index of the sample's episode
    tasks: Tensor  # (n,) int64, index into `task_names`
    task_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.states)

    def where(self, mask: Tensor) -> Samples:
        frames = self.frames[mask] if self.frames is not None else None
        states, chunks, words = self.states[mask], self.chunks[mask], self.words[mask]
        return Samples(frames, states, chunks, words, self.episodes[mask], self.tasks[mask], self.task_names)

    def inputs(self, indices: Tensor, device: torch.device) -> Inputs:
        images = None
        if self.frames is not None:
            images = self.frames[indices].to(device).permute(0, 3, 1, 2)
        return Inputs(images, self.states[indices].to(device), self.words[indices].to(device))


def load_samples(
    dataset: DemoDataset,
    settings: TargetSettings,
    words: WordTokenizer,
    task_names: tuple[str, ...],
    on_episode: Callable[[int, int], None] = lambda done, total: None,
) -> Samples:
    """Read the tasks' episodes. Vision policies take the steps that have a frame, state policies every step."""
    chosen = [i for i, e in enumerate(dataset.episodes) if e.task in task_names]
    missing = set(task_names) - {dataset.episodes[i].task for i in chosen}
    if missing:
        raise CheckpointError(f"the demonstrations hold no episode of {', '.join(sorted(missing))}: record them first")
    parts: list[tuple[np.ndarray | None, np.ndarray, np.ndarray, list[int], int, int]] = []
    for number, index in enumerate(chosen):
        episode = dataset.load(index)
        frames, steps = _frames_and_steps(episode, settings)
        chunks = np.stack([episode.labels[t : t + settings.chunk] for t in steps])
        ids = words.encode(spec_of(episode.task).task(episode.task).instruction, settings.instruction_tokens)
        parts.append((frames, episode.states[steps], chunks, ids, number, task_names.index(episode.task)))
        on_episode(number + 1, len(chosen))
    counts = [len(p[1]) for p in parts]
    images = np.concatenate([p[0] for p in parts if p[0] is not None]) if settings.observation == "vision" else None
    return Samples(
        frames=torch.from_numpy(images) if images is not None else None,
        states=torch.from_numpy(np.concatenate([p[1] for p in parts])).float(),
        chunks=torch.from_numpy(np.concatenate([p[2] for p in parts])).float(),
        words=torch.tensor([p[3] for p in parts]).repeat_interleave(torch.tensor(counts), 0),
        episodes=torch.tensor([p[4] for p in parts]).repeat_interleave(torch.tensor(counts)),
        tasks=torch.tensor([p[5] for p in parts]).repeat_interleave(torch.tensor(counts)),
        task_names=task_names,
    )


def _frames_and_steps(episode: DemoEpisode, settings: TargetSettings) -> tuple[np.ndarray | None, np.ndarray]:
    if settings.chunk > len(episode.labels) - episode.steps + 1:
        raise CheckpointError(
            f"the demonstrations have {len(episode.labels) - episode.steps} labels behind an episode's end, "
            f"chunks of {settings.chunk} need {settings.chunk - 1}: record them again with a longer tail"
        )
    if settings.observation == "state":
        return None, np.arange(episode.steps)
    if episode.frames.shape[1] != settings.image_size:
        raise CheckpointError(
            f"the demonstrations' frames have {episode.frames.shape[1]} pixels, the policy takes "
            f"{settings.image_size}: set target.image_size or record again with world.camera.size"
        )
    return episode.frames, episode.frame_steps


def split(samples: Samples, share: float) -> tuple[Samples, Samples]:
    """(training, held out), by whole episodes."""
    held = held_out_of(samples.episodes, share)
    return samples.where(~held), samples.where(held)


def held_out_of(episodes: Tensor, share: float) -> Tensor:
    """episodes (n,) -> (n,) bool: every k-th episode, so that each task and both kinds are on both sides."""
    count = int(episodes.max()) + 1
    if count < 2:
        raise CheckpointError("one demonstration cannot be both trained on and held out: record at least two")
    if not 0 < share <= 0.5:
        raise UsageError(f"train.held_out={share}: more than 0, at most 0.5")
    every = min(max(2, round(1 / share)), count)
    return episodes % every == every - 1


def soft_labels(sigma: float) -> Tensor:
    """(V, V) row per true bin: a discrete Gaussian of `sigma` bins; the identity for sigma 0."""
    bins = torch.arange(VOCABULARY, dtype=torch.float32)
    if sigma <= 0:
        return torch.eye(VOCABULARY)
    return torch.softmax(-((bins[:, None] - bins) ** 2) / (2 * sigma**2), -1)


def token_loss(logits: Tensor, tokens: Tensor, labels: Tensor) -> Tensor:
    """Mean cross-entropy of logits (B, N, V) with the soft labels of tokens (B, N)."""
    return -(labels[tokens] * F.log_softmax(logits.float(), -1)).sum(-1).mean()


class Imitation:
    """Losses and metrics of one training run."""

    def __init__(self, target: Target, samples: Samples, settings: TrainSettings, device: torch.device) -> None:
        self.target, self.settings, self.device = target, settings, device
        self.training, self.held_out = split(samples, settings.held_out)
        self.labels = soft_labels(settings.label_sigma).to(device)

    def tokens(self, samples: Samples, indices: Tensor) -> Tensor:
        """(B, N) int64."""
        encoded = self.target.actions.encode(samples.chunks[indices].numpy())
        return torch.from_numpy(encoded).flatten(1).to(self.device)

    def autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bf16)

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        inputs = self.training.inputs(indices, self.device)
        scene = self.settings.scene_weight if self.target.needs_frame else 0.0
        with self.autocast():
            if scene and step < self.settings.scene_steps:
                _, positions = self.target.encode(inputs)
                loss = position_loss(positions, inputs.states)
                return loss, {"position_loss": float(loss.detach())}
            tokens = self.tokens(self.training, indices)
            logits, positions = self.target(inputs, tokens)
            loss = token_loss(logits, tokens, self.labels)
            metrics = {"token_loss": float(loss.detach())}
            if scene:
                extra = position_loss(positions, inputs.states)
                loss = loss + scene * extra
                metrics["position_loss"] = float(extra.detach())
        return loss, metrics

    @torch.no_grad()
    def validate(self, module: nn.Module, limit: int = 2048) -> Metrics:
        """Teacher-forced metrics on held-out episodes; the score is minus the mean action L1."""
        assert isinstance(module, Target)
        chosen = torch.linspace(0, len(self.held_out) - 1, min(limit, len(self.held_out))).long()
        hits, close, errors, offsets = [], [], [], []
        for indices in chosen.split(256):
            inputs = self.held_out.inputs(indices, self.device)
            tokens = self.tokens(self.held_out, indices)
            logits, positions = module(inputs, tokens)
            guess = logits.argmax(-1)
            distance = (guess - tokens).abs()
            hits.append((distance == 0).float().flatten())
            close.append((distance <= WITHIN).float().flatten())
            gap = np.abs(values_of(guess.cpu().numpy()) - values_of(tokens.cpu().numpy()))
            errors.append(gap.reshape(-1, module.settings.dofs))
            offsets.append((positions - scene_of(inputs.states)).unflatten(-1, (2, 3)).norm(dim=-1))
        error = np.concatenate(errors).mean(0)
        metrics = {
            "score": -float(error.mean()),
            "token_accuracy": float(torch.cat(hits).mean()),
            f"within_{WITHIN}": float(torch.cat(close).mean()),
            "action_l1": float(error.mean()),
            **{f"l1_{name}": float(e) for name, e in zip(DOF_NAMES, error, strict=True)},
        }
        if module.needs_frame:
            object_error, goal_error = torch.cat(offsets).median(0).values.tolist()
            metrics |= {"object_error_cm": 100 * object_error, "goal_error_cm": 100 * goal_error}
        return metrics


def scene_of(states: Tensor) -> Tensor:
    """(B, 39) -> (B, 6) object and goal positions, metres."""
    return torch.cat([states[:, OBJECT], states[:, GOAL]], -1)


def position_loss(positions: Tensor, states: Tensor) -> Tensor:
    """Smooth L1 of estimated positions (B, 6), in units of 2 cm."""
    return F.smooth_l1_loss(positions / 0.02, scene_of(states) / 0.02, beta=1.0) * 0.5


def new_target(settings: TargetSettings, samples: Samples, seed: int) -> Target:
    """A fresh policy with the samples' action statistics."""
    torch.manual_seed(seed)
    actions = ActionTokenizer.fit(samples.chunks[:, 0].numpy().astype(np.float64))
    return Target(replace(settings), actions, vocabulary())


def check_init(settings: TargetSettings, description: dict[str, Any], folder: Path) -> None:
    """Whether the target in `folder`, described by its JSON, can be fine-tuned to `settings`: no weight depends on the
    chunk length, all else must agree.

    Raises:
        UsageError: the first shape that differs.
    """
    for name, wanted in asdict(settings).items():
        there = description["settings"].get(name)
        if name not in ("size", "chunk") and there != wanted:
            raise UsageError(
                f"train.init: the target in {folder} has {name}={there}, the run target.{name}={wanted}: set both alike"
            )


def continued_target(settings: TargetSettings, init: Target) -> Target:
    """A policy of `settings` that begins with a copy of the weights of `init` and shares its statistics and words."""
    target = Target(replace(settings), init.actions, init.words)
    target.load_state_dict(init.state_dict())
    return target


def vocabulary() -> WordTokenizer:
    return WordTokenizer.build(t.instruction for t in TASKS.values())


def imitation_job(
    run: Imitation,
    save: Callable[[nn.Module, Metrics], None],
    closed_loop: Callable[[Target], float] | None = None,
) -> Job:
    """The run as the shared loop takes it. With `closed_loop` (success in [0, 1]) success outranks the action error."""

    def validate(module: nn.Module) -> Metrics:
        metrics = run.validate(module)
        if closed_loop is not None:
            assert isinstance(module, Target)
            metrics["closed_loop_success"] = closed_loop(module)
            metrics["score"] += 10 * metrics["closed_loop_success"]
        return metrics

    return Job(run.target, len(run.training), run.loss, validate, save)
