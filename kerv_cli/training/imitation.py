"""Behaviour cloning of a compact target: samples, losses, validation, and the network to begin with.

One sample is one recorded control step: the observation, and the expert's next H clean actions as tokens. Validation
uses held-out episodes. Token accuracy does not show success: two policies with the same accuracy can differ by half of
the tasks. So success in closed-loop episodes dominates the score if the settings ask for it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.targets.compact.bfloat16 import has_tiles
from kerv_cli.targets.compact.features import places_of
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.targets.losses import position_loss, soft_labels, token_loss
from kerv_cli.targets.observations import Observations, read_chunks, read_observations, split
from kerv_cli.training.loop import Metrics
from kerv_cli.training.settings import TrainSettings
from kerv_cli.worlds import specs
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

WITHIN = 9
"""Validation reports the share of tokens that are off by at most this many bins: Spec-VLA's relaxed radius."""
VALIDATED = 2048
"""Samples of a validation, at most."""


@dataclass(frozen=True)
class Samples(Observations):
    """The training data of a policy: observations and the expert's chunks."""

    chunks: Tensor  # (n, H, D) float32, the expert's clean actions, environment units
    places: Tensor  # (n, K, 3) float32, the positions that are learnt, metres
    episodes: Tensor  # (n,) int64, index of the sample's episode
    tasks: Tensor  # (n,) int64, index of the sample's task


def load_samples(
    dataset: DemoDataset,
    settings: TargetSettings,
    words: WordTokenizer,
    task_names: tuple[str, ...],
    progress: OnProgress = lambda done, total: None,
    places: str = "state",
) -> Samples:
    """Read the tasks' episodes into memory; `places` as in `TrainSettings`.

    Raises:
        CheckpointError: Too few labels or frames of another size.
    """
    chosen = [i for i, entry in enumerate(dataset.episodes) if entry.task in task_names]
    parts = []
    for number, index in enumerate(chosen):
        episode = dataset.load(index)
        observations = read_observations(episode, settings, dataset.manifest.observation, words)
        steps, count = observations.steps.numpy(), len(observations)
        learnt = places_of(observations.states, dataset.manifest.observation)
        if places == "path":
            learnt = waypoints(episode, steps, learnt.shape[1], dataset.manifest.actions)
        sample = Samples(
            **vars(observations),
            chunks=torch.from_numpy(read_chunks(episode, steps, settings.chunk)).float(),
            places=learnt,
            episodes=torch.full((count,), number),
            tasks=torch.full((count,), task_names.index(episode.task)),
        )
        parts.append(sample)
        progress(number + 1, len(chosen))
    return Samples.joined(parts)


def waypoints(episode: DemoEpisode, steps: np.ndarray, count: int, actions: ActionSpace) -> Tensor:
    """Return where the hand will be when the gripper changes, and at the episode's end.

    The demonstration itself shows these positions, without a simulator's state. The gripper changes when a strict DoF
    of the expert's command moves by more than an eighth of its range in one control step.

    Args:
        episode: A demonstration.
        steps: (n,) control steps.
        count: K positions: of the next K − 1 changes after a step, and of the end. A missing change is the end.
        actions: The action space.

    Returns:
        (n, K, 3) float32, metres.
    """
    commands = episode.labels[: episode.steps, actions.is_strict]
    changes = np.flatnonzero((abs(np.diff(commands, axis=0)) > actions.half[actions.is_strict] / 4).any(-1)) + 1
    last = episode.steps - 1
    times = np.append(changes, [last] * count)
    first = np.searchsorted(changes, steps, side="right")
    reached = np.concatenate([times[first[:, None] + np.arange(count - 1)], np.full((len(steps), 1), last)], 1)
    return torch.from_numpy(episode.end_effector[reached]).float()


def task_weights(tasks: Tensor, balance: float) -> Tensor | None:
    """Return the weights (n,) float64 by which samples are drawn; None if all are drawn alike.

    A task with the share p of the samples is drawn in proportion to p^(1 − balance).

    Args:
        tasks: (n,) index of each sample's task.
        balance: 0 draws all samples alike, 1 all tasks.
    """
    if balance == 0:
        return None
    shares = torch.bincount(tasks).double() / len(tasks)
    weights: Tensor = shares[tasks] ** -balance
    return weights


def lit(images: Tensor, indices: Tensor, step: int, spread: float) -> Tensor:
    """Return images (B, 3, h, w) uint8 under random light, a function of the samples' indices (B,) and the step.

    Each colour is multiplied by the exponential of a smooth field, with a standard deviation drawn from 0 to `spread`
    per image. Nothing moves.
    """
    draws = [np.random.default_rng((step, index)) for index in indices.tolist()]
    fields = np.stack([spread * r.uniform() * r.normal(size=(3, 3, 3)) for r in draws])
    factors = torch.from_numpy(fields).float().to(images.device).exp()
    light = F.interpolate(factors, images.shape[-2:], mode="bilinear", align_corners=True)
    return (images * light).round_().clamp_(0, 255).to(torch.uint8)


class Imitation:
    """The objective of a target.

    Args:
        target: The module to train, on its device.
        samples: All samples; whole episodes of them are held out.
        settings: Optimisation settings.
        closed_loop: Measures a target's success in [0, 1], which then dominates the score.
    """

    def __init__(
        self,
        target: CompactTarget,
        samples: Samples,
        settings: TrainSettings,
        closed_loop: Callable[[CompactTarget], float] | None = None,
    ) -> None:
        self.module, self.settings, self.device, self.closed_loop = target, settings, target.device, closed_loop
        self.training, self.held_out = split(samples, settings.held_out)
        self.labels = soft_labels(target.actions.tokens, settings.label_sigma).to(self.device)
        self.weights = task_weights(self.training.tasks, settings.balance)
        self.learns_places = bool(target.cameras and settings.scene_weight)

    def __len__(self) -> int:
        return len(self.training)

    def tokens(self, samples: Samples, indices: Tensor) -> Tensor:
        """Return the chunks at `indices` (B,) as tokens (B, N) int64."""
        encoded = self.module.actions.encode(samples.chunks[indices].numpy())
        return torch.from_numpy(encoded).flatten(1).to(self.device)

    @contextlib.contextmanager
    def precision(self) -> Iterator[None]:
        """Compute in bfloat16 if the settings ask for it, on a GPU or a CPU with AMX; other CPUs are slower with it.

        With AMX the attention is computed by its formula: the fused kernel's backward pass takes four times as long.
        """
        gpu = self.device.type != "cpu"
        bf16 = self.settings.bf16 and (gpu or has_tiles())
        kernels = [SDPBackend.MATH]
        if gpu or not bf16:
            kernels += [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION]
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16), sdpa_kernel(kernels):
            yield

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Return token loss plus weighted position loss; in the first `scene_steps` the position loss alone."""
        inputs = self.training.inputs(indices, self.device)
        if self.settings.colour and inputs.images is not None:
            inputs = replace(inputs, images=lit(inputs.images, indices, step, self.settings.colour))
        with self.precision():
            places = self.training.places[indices].to(self.device)
            if self.learns_places and step < self.settings.scene_steps:
                loss = position_loss(self.module.encode_batch(inputs)[1], places)
                return loss, {"position_loss": float(loss.detach())}
            tokens = self.tokens(self.training, indices)
            logits, positions = self.module.teacher_forced(inputs, tokens)
            loss = token_loss(logits, tokens, self.labels)
            metrics = {"token_loss": float(loss.detach())}
            if self.learns_places:
                of_places = position_loss(positions, places)
                loss = loss + self.settings.scene_weight * of_places
                metrics["position_loss"] = float(of_places.detach())
        return loss, metrics

    @torch.no_grad()
    def validate(self, module: nn.Module) -> Metrics:
        """Return teacher-forced metrics on held-out episodes.

        The score is minus the mean action L1, plus ten times the success if that is measured.
        """
        assert isinstance(module, CompactTarget)
        chosen = torch.linspace(0, len(self.held_out) - 1, min(VALIDATED, len(self.held_out))).long()
        distances, gaps, offsets = [], [], []
        actions = module.actions
        for indices in chosen.split(256):
            inputs = self.held_out.inputs(indices, self.device)
            tokens = self.tokens(self.held_out, indices)
            logits, positions = module.teacher_forced(inputs, tokens)
            guess = logits.argmax(-1)
            distances.append((guess - tokens).abs().flatten())
            gap = np.abs(actions.values_of(guess.cpu().numpy()) - actions.values_of(tokens.cpu().numpy()))
            gaps.append(gap.reshape(-1, actions.dofs))
            offsets.append((positions - self.held_out.places[indices].to(self.device)).norm(dim=-1))
        distance, error = torch.cat(distances), np.concatenate(gaps).mean(0)
        metrics = {
            "score": -float(error.mean()),
            "token_accuracy": float((distance == 0).float().mean()),
            f"within_{WITHIN}": float((distance <= WITHIN).float().mean()),
            "action_l1": float(error.mean()),
            **{f"l1_{name}": float(e) for name, e in zip(actions.names, error, strict=True)},
        }
        if self.learns_places:
            medians = torch.cat(offsets).median(0).values.tolist()
            names = [place.name.replace(" ", "_") for place in module.observation.places]
            if self.settings.places == "path":
                names = [f"waypoint_{number}" for number in range(1, len(names) + 1)]
            metrics |= {f"{name}_error_cm": 100 * e for name, e in zip(names, medians, strict=True)}
        if self.closed_loop is not None:
            metrics["closed_loop_success"] = self.closed_loop(module)
            metrics["score"] += 10 * metrics["closed_loop_success"]
        return metrics


def check_init(settings: TargetSettings, camera: str, description: TargetDescription, folder: Path) -> None:
    """Refuse a target in `folder` that cannot be trained on with these settings and frames of `camera`.

    Only the name, the chunk length, the norm and `parallel` may differ, and `camera` may add views.

    Raises:
        UsageError: The first shape that differs.
    """
    for name, value in asdict(settings).items():
        stored = description.settings.get(name)
        if name not in ("size", "chunk", "parallel", "norm") and stored != value:
            raise UsageError(
                f"train.init: the target in {folder} has {name}={stored}, the run target.{name}={value}: set both alike"
            )
    trained = description.cameras[0] if description.cameras else ""
    if settings.observation == "vision" and not f"{camera}+".startswith(f"{trained}+"):
        raise UsageError(
            f"train.init: the target in {folder} sees {trained}, the run {camera}: world.camera.name must be "
            f"{trained}, or begin with {trained}+"
        )


def continued_target(settings: TargetSettings, init: CompactTarget, camera: str) -> CompactTarget:
    """Return a policy of `settings` that begins with the weights, statistics and words of `init`.

    Only the queries of a parallel target are fresh. An added view of `camera` begins with the first one's encoder, and
    the estimated positions do not depend on it yet.
    """
    target = CompactTarget(replace(settings), init.actions, init.observation, init.words, camera)
    fresh = {k: v for k, v in target.state_dict().items() if k == "queries"}
    weights = {**fresh, **{k: v for k, v in init.state_dict().items() if k in target.state_dict()}}
    if target.cameras:
        for view in range(len(init.encoders) - 1, len(target.encoders) - 1):
            weights |= {f"further_views.{view}.{k}": v for k, v in init.vision.state_dict().items()}
        points = 2 * settings.keypoints * len(init.encoders)
        added = 2 * settings.keypoints * len(target.encoders) - points
        weight = weights["locate.0.weight"]
        columns = [weight[:, :points], weight.new_zeros(len(weight), added), weight[:, points:]]
        weights["locate.0.weight"] = torch.cat(columns, 1)
    target.load_state_dict(weights)
    return target


def vocabulary(environment: str) -> WordTokenizer:
    """Return a tokenizer of the words in the instructions of all tasks of an environment."""
    return WordTokenizer.build(t.instruction for t in specs()[environment].tasks.values())
