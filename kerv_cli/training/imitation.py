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

from kerv_cli.environments import spec_of, specs
from kerv_cli.environments.demos.dataset import DemoDataset
from kerv_cli.environments.demos.episode_file import DemoEpisode
from kerv_cli.errors import CheckpointError, UsageError
from kerv_cli.settings import TargetSettings, TrainSettings
from kerv_cli.spaces import ObservationSpace
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.targets.compact.features import places_of
from kerv_cli.targets.compact.target import CompactTarget, Inputs
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.training.loop import Job, Metrics

WITHIN = 9  # bins; the share of tokens this close is reported (Spec-VLA's relaxed radius)


@dataclass(frozen=True)
class Samples:
    """Everything a policy is trained on, in memory; n samples in episode order."""

    frames: Tensor | None  # (n, s, s, 3) uint8
    proprioception: Tensor  # (n, p) float32
    states: Tensor  # (n, s) float32, privileged
    chunks: Tensor  # (n, H, D) float32, the expert's clean actions, environment units
    words: Tensor  # (n, L) int64
    episodes: Tensor  # (n,) int64, index of the sample's episode
    tasks: Tensor  # (n,) int64, index into `task_names`
    task_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.states)

    def where(self, mask: Tensor) -> Samples:
        """The samples where mask (n,) bool is set."""
        chosen: dict[str, Any] = {k: v[mask] for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **chosen)

    def inputs(self, indices: Tensor, device: torch.device) -> Inputs:
        """The observations at `indices` (B,) as a batch."""
        images = None
        if self.frames is not None:
            images = self.frames[indices].to(device).permute(0, 3, 1, 2)
        return Inputs(images, *(x[indices].to(device) for x in (self.proprioception, self.states, self.words)))


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
    parts: list[dict[str, Tensor]] = []
    for number, index in enumerate(chosen):
        episode = dataset.load(index)
        frames, steps = frames_and_steps(episode, settings)
        felt, states = observed(episode, steps, dataset.manifest.observation)
        ids = torch.tensor([words.encode(instruction_of(episode.task), settings.instruction_tokens)])
        parts.append(
            {
                **({} if frames is None else {"frames": torch.from_numpy(frames)}),
                "proprioception": torch.from_numpy(felt).float(),
                "states": torch.from_numpy(states).float(),
                "chunks": torch.from_numpy(np.stack([episode.labels[t : t + settings.chunk] for t in steps])).float(),
                "words": ids.repeat(len(steps), 1),
                "episodes": torch.full((len(steps),), number),
                "tasks": torch.full((len(steps),), task_names.index(episode.task)),
            }
        )
        on_episode(number + 1, len(chosen))
    whole: dict[str, Any] = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return Samples(**{"frames": None, **whole}, task_names=task_names)


def instruction_of(name: str) -> str:
    """What the robot is told in a task."""
    return spec_of(name).task(name).instruction


def observed(episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace) -> tuple[np.ndarray, np.ndarray]:
    """Proprioception (n, p) and privileged state (n, s) at `steps` (n,)."""
    states = episode.states[steps]
    return states[:, : len(space.proprioception)], states


def frames_and_steps(episode: DemoEpisode, settings: TargetSettings) -> tuple[np.ndarray | None, np.ndarray]:
    """The episode's frames (n, size, size, 3), None for a state policy, and the control steps (n,) that a policy of
    these settings learns from.

    Raises:
        CheckpointError: too few labels behind the episode's end for a whole chunk, or frames of another size.
    """
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


def soft_labels(tokens: int, sigma: float) -> Tensor:
    """(V, V) row per true bin of V = `tokens`: a discrete Gaussian of `sigma` bins; the identity for sigma 0."""
    bins = torch.arange(tokens, dtype=torch.float32)
    if sigma <= 0:
        return torch.eye(tokens)
    return torch.softmax(-((bins[:, None] - bins) ** 2) / (2 * sigma**2), -1)


def token_loss(logits: Tensor, tokens: Tensor, labels: Tensor) -> Tensor:
    """Mean cross-entropy of logits (B, N, V) with the soft labels of tokens (B, N)."""
    return -(labels[tokens] * F.log_softmax(logits.float(), -1)).sum(-1).mean()


class Imitation:
    """Losses and metrics of one training run."""

    def __init__(self, target: CompactTarget, samples: Samples, settings: TrainSettings, device: torch.device) -> None:
        self.target, self.settings, self.device = target, settings, device
        self.training, self.held_out = split(samples, settings.held_out)
        self.labels = soft_labels(target.actions.tokens, settings.label_sigma).to(device)

    def tokens(self, samples: Samples, indices: Tensor) -> Tensor:
        """(B, N) int64."""
        encoded = self.target.actions.encode(samples.chunks[indices].numpy())
        return torch.from_numpy(encoded).flatten(1).to(self.device)

    def autocast(self) -> torch.autocast:
        """bfloat16 where it is asked for."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bf16)

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Of a batch; in the first `scene_steps` of the positions alone."""
        inputs = self.training.inputs(indices, self.device)
        scene = self.settings.scene_weight if self.target.cameras else 0.0
        with self.autocast():
            if scene and step < self.settings.scene_steps:
                _, positions = self.target.encode_batch(inputs)
                loss = position_loss(positions, places_of(inputs.states, self.target.observation))
                return loss, {"position_loss": float(loss.detach())}
            tokens = self.tokens(self.training, indices)
            logits, positions = self.target.teacher_forced(inputs, tokens)
            loss = token_loss(logits, tokens, self.labels)
            metrics = {"token_loss": float(loss.detach())}
            if scene:
                extra = position_loss(positions, places_of(inputs.states, self.target.observation))
                loss = loss + scene * extra
                metrics["position_loss"] = float(extra.detach())
        return loss, metrics

    @torch.no_grad()
    def validate(self, module: nn.Module, limit: int = 2048) -> Metrics:
        """Teacher-forced metrics on held-out episodes; the score is minus the mean action L1."""
        assert isinstance(module, CompactTarget)
        chosen = torch.linspace(0, len(self.held_out) - 1, min(limit, len(self.held_out))).long()
        hits, close, errors, offsets = [], [], [], []
        actions = module.actions
        for indices in chosen.split(256):
            inputs = self.held_out.inputs(indices, self.device)
            tokens = self.tokens(self.held_out, indices)
            logits, positions = module.teacher_forced(inputs, tokens)
            guess = logits.argmax(-1)
            distance = (guess - tokens).abs()
            hits.append((distance == 0).float().flatten())
            close.append((distance <= WITHIN).float().flatten())
            gap = np.abs(actions.values_of(guess.cpu().numpy()) - actions.values_of(tokens.cpu().numpy()))
            errors.append(gap.reshape(-1, actions.dofs))
            offsets.append((positions - places_of(inputs.states, module.observation)).norm(dim=-1))
        error = np.concatenate(errors).mean(0)
        metrics = {
            "score": -float(error.mean()),
            "token_accuracy": float(torch.cat(hits).mean()),
            f"within_{WITHIN}": float(torch.cat(close).mean()),
            "action_l1": float(error.mean()),
            **{f"l1_{name}": float(e) for name, e in zip(actions.names, error, strict=True)},
        }
        if module.cameras:
            medians = torch.cat(offsets).median(0).values.tolist()
            names = [place.name.replace(" ", "_") for place in module.observation.places]
            metrics |= {f"{name}_error_cm": 100 * e for name, e in zip(names, medians, strict=True)}
        return metrics


def position_loss(estimated: Tensor, places: Tensor) -> Tensor:
    """Smooth L1 of estimated positions (B, K, 3) metres, in units of 2 cm."""
    return F.smooth_l1_loss(estimated / 0.02, places / 0.02, beta=1.0) * 0.5


def new_target(
    settings: TargetSettings, dataset: DemoDataset, samples: Samples, words: WordTokenizer, camera: str, seed: int
) -> CompactTarget:
    """A fresh policy of the dataset's spaces with the samples' action statistics."""
    torch.manual_seed(seed)
    actions = dataset.manifest.actions.fitted(samples.chunks[:, 0].numpy().astype(np.float64))
    return CompactTarget(replace(settings), actions, dataset.manifest.observation, words, camera)


def check_init(settings: TargetSettings, description: TargetDescription, folder: Path) -> None:
    """Whether the target in `folder`, described by its JSON, can be fine-tuned to `settings`: no weight depends on the
    chunk length, all else must agree.

    Raises:
        UsageError: the first shape that differs.
    """
    for name, wanted in asdict(settings).items():
        there = description.settings.get(name)
        if name not in ("size", "chunk") and there != wanted:
            raise UsageError(
                f"train.init: the target in {folder} has {name}={there}, the run target.{name}={wanted}: set both alike"
            )


def continued_target(settings: TargetSettings, init: CompactTarget) -> CompactTarget:
    """A policy of `settings` that begins with a copy of the weights of `init` and shares its statistics and words."""
    camera = init.cameras[0] if init.cameras else ""
    target = CompactTarget(replace(settings), init.actions, init.observation, init.words, camera)
    target.load_state_dict(init.state_dict())
    return target


def check_spaces(target: CompactTarget, dataset: DemoDataset) -> None:
    """Refuse demonstrations of another environment than the target's.

    Raises:
        CheckpointError: other actions or observations.
    """
    target.actions.check_same(dataset.manifest.actions, "the target", f"the demonstrations in {dataset.path}")
    if target.observation != dataset.manifest.observation:
        raise CheckpointError(
            f"the demonstrations in {dataset.path} have other observations than the target was trained on: "
            "they are of another environment"
        )


def vocabulary(environment: str) -> WordTokenizer:
    """All words of the environment's instructions."""
    return WordTokenizer.build(t.instruction for t in specs()[environment].tasks.values())


def imitation_job(
    run: Imitation,
    save: Callable[[nn.Module, Metrics], None],
    closed_loop: Callable[[CompactTarget], float] | None = None,
) -> Job:
    """The run as the shared loop takes it. With `closed_loop` (success in [0, 1]) success outranks the action error."""

    def validate(module: nn.Module) -> Metrics:
        metrics = run.validate(module)
        if closed_loop is not None:
            assert isinstance(module, CompactTarget)
            metrics["closed_loop_success"] = closed_loop(module)
            metrics["score"] += 10 * metrics["closed_loop_success"]
        return metrics

    return Job(run.target, len(run.training), run.loss, validate, save)
