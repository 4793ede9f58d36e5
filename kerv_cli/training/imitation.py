"""Behaviour cloning of the target on demonstrations.

One sample is one recorded control step: the observation, and the expert's next H clean actions as tokens. Validation
uses held-out *episodes*. Token accuracy does not show success (two policies with the same accuracy can differ by half
of the tasks), so the score is the success of closed-loop episodes where the settings ask for them.
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
from kerv_cli.targets.compact.features import places_of
from kerv_cli.targets.compact.packed_bfloat16 import has_tiles
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.training.loop import Metrics
from kerv_cli.training.observations import Observations, read_chunks, read_observations, split
from kerv_cli.training.settings import TrainSettings
from kerv_cli.worlds import specs
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

WITHIN = 9
"""Bins; validation reports the share of tokens that are off by at most this many (the relaxed radius of Spec-VLA)."""
VALIDATED = 2048
"""Most samples of a validation."""


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
    on_progress: OnProgress = lambda done, total: None,
    places: str = "state",
) -> Samples:
    """Reads the tasks' episodes, one of each at least, into memory. places: as `train.places`.

    Raises:
        CheckpointError: too few labels or frames of another size.
    """
    chosen = [i for i, e in enumerate(dataset.episodes) if e.task in task_names]
    parts = []
    for number, index in enumerate(chosen):
        episode = dataset.load(index)
        observations = read_observations(episode, settings, dataset.manifest.observation, words)
        chunks = torch.from_numpy(read_chunks(episode, observations.steps.numpy(), settings.chunk)).float()
        episodes = torch.full((len(observations),), number)
        tasks = torch.full_like(episodes, task_names.index(episode.task))
        learnt = places_of(observations.states, dataset.manifest.observation)
        if places == "path":
            learnt = waypoints(episode, observations.steps.numpy(), learnt.shape[1], dataset.manifest.actions)
        parts.append(Samples(**vars(observations), chunks=chunks, places=learnt, episodes=episodes, tasks=tasks))
        on_progress(number + 1, len(chosen))
    return Samples.joined(parts)


def waypoints(episode: DemoEpisode, steps: np.ndarray, count: int, actions: ActionSpace) -> Tensor:
    """(n, K, 3) float32 for K = `count`: where the hand is when strict DoFs (a gripper) next change, K − 1 times behind
    each of `steps` (n,), and at the episode's end, metres. Positions that a demonstration itself shows, without a
    simulator's state. A change: the expert's command moves by more than an eighth of its range in one control step; one
    that does not come is the end."""
    commands = episode.labels[: episode.steps, actions.is_strict]
    changes = np.flatnonzero((abs(np.diff(commands, axis=0)) > actions.half[actions.is_strict] / 4).any(-1)) + 1
    last = episode.steps - 1
    times = np.append(changes, [last] * count)
    first = np.searchsorted(changes, steps, side="right")
    at = np.concatenate([times[first[:, None] + np.arange(count - 1)], np.full((len(steps), 1), last)], 1)
    return torch.from_numpy(episode.end_effector[at]).float()


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


def soft_labels(tokens: int, sigma: float) -> Tensor:
    """(V, V) row per true bin of V = `tokens`: a discrete Gaussian of `sigma` bins; the identity for sigma 0."""
    bins = torch.arange(tokens, dtype=torch.float32)
    if sigma <= 0:
        return torch.eye(tokens)
    return torch.softmax(-((bins[:, None] - bins) ** 2) / (2 * sigma**2), -1)


def token_loss(logits: Tensor, tokens: Tensor, labels: Tensor) -> Tensor:
    """Mean cross-entropy of logits (B, N, V) with the soft labels of tokens (B, N)."""
    return -(labels[tokens] * F.log_softmax(logits.float(), -1)).sum(-1).mean()


def lit(images: Tensor, indices: Tensor, step: int, spread: float) -> Tensor:
    """images (B, 3, h, w) uint8 under random light: each colour is multiplied by the exponential of a smooth field,
    whose standard deviation is drawn from 0 to `spread` per image. The field depends on the sample's index (B,) and the
    step alone. Places in the image stay where they are."""
    draws = [np.random.default_rng((step, index)) for index in indices.tolist()]
    fields = np.stack([spread * r.uniform() * r.normal(size=(3, 3, 3)) for r in draws])
    factors = torch.from_numpy(fields).float().to(images.device).exp()
    light = F.interpolate(factors, images.shape[-2:], mode="bilinear", align_corners=True)
    return (images * light).round_().clamp_(0, 255).to(torch.uint8)


class Imitation:
    """Losses and metrics of one training run. closed_loop: a target's success in [0, 1], which then dominates the
    score; None: not measured."""

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

    def __len__(self) -> int:
        return len(self.training)

    def tokens(self, samples: Samples, indices: Tensor) -> Tensor:
        """The chunks of `samples` at `indices` (B,) as tokens (B, N) int64."""
        encoded = self.module.actions.encode(samples.chunks[indices].numpy())
        return torch.from_numpy(encoded).flatten(1).to(self.device)

    @contextlib.contextmanager
    def precision(self) -> Iterator[None]:
        """bfloat16 autocast where the settings ask for it, on a GPU or a CPU with AMX: another CPU is slower with it,
        by a third with AVX512-BF16, several times without. With AMX attention is computed by its formula: the backward
        pass of the fused kernel takes four times as long there."""
        gpu = self.device.type != "cpu"
        bf16 = self.settings.bf16 and (gpu or has_tiles())
        fused = gpu or not bf16
        kernels = [SDPBackend.MATH] + [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION] * fused
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16), sdpa_kernel(kernels):
            yield

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Token loss and weighted position loss at `indices` (B,); in the first `scene_steps` the position
        loss alone."""
        inputs = self.training.inputs(indices, self.device)
        if self.settings.colour and inputs.images is not None:
            inputs = replace(inputs, images=lit(inputs.images, indices, step, self.settings.colour))
        scene = self.settings.scene_weight if self.module.cameras else 0.0
        with self.precision():
            places = self.training.places[indices].to(self.device)
            if scene and step < self.settings.scene_steps:
                loss = position_loss(self.module.encode_batch(inputs)[1], places)
                return loss, {"position_loss": float(loss.detach())}
            tokens = self.tokens(self.training, indices)
            logits, positions = self.module.teacher_forced(inputs, tokens)
            loss = token_loss(logits, tokens, self.labels)
            metrics = {"token_loss": float(loss.detach())}
            if scene:
                extra = position_loss(positions, places)
                loss = loss + scene * extra
                metrics["position_loss"] = float(extra.detach())
        return loss, metrics

    @torch.no_grad()
    def validate(self, module: nn.Module) -> Metrics:
        """Teacher-forced metrics on held-out episodes; the score is minus the mean action L1, plus ten times the
        success where it is measured."""
        assert isinstance(module, CompactTarget)
        chosen = torch.linspace(0, len(self.held_out) - 1, min(VALIDATED, len(self.held_out))).long()
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
            offsets.append((positions - self.held_out.places[indices].to(self.device)).norm(dim=-1))
        error = np.concatenate(errors).mean(0)
        metrics = {
            "score": -float(error.mean()),
            "token_accuracy": float(torch.cat(hits).mean()),
            f"within_{WITHIN}": float(torch.cat(close).mean()),
            "action_l1": float(error.mean()),
            **{f"l1_{name}": float(e) for name, e in zip(actions.names, error, strict=True)},
        }
        if module.cameras and self.settings.scene_weight:
            medians = torch.cat(offsets).median(0).values.tolist()
            names = [place.name.replace(" ", "_") for place in module.observation.places]
            if self.settings.places == "path":
                names = [f"waypoint_{number}" for number in range(1, len(names) + 1)]
            metrics |= {f"{name}_error_cm": 100 * e for name, e in zip(names, medians, strict=True)}
        if self.closed_loop is not None:
            metrics["closed_loop_success"] = self.closed_loop(module)
            metrics["score"] += 10 * metrics["closed_loop_success"]
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


def check_init(settings: TargetSettings, camera: str, description: TargetDescription, folder: Path) -> None:
    """Checks that the target in `folder`, with this description, can be fine-tuned to `settings` and to frames of
    `camera`. All settings but the chunk length and the norm, on which no weight's shape depends, and `parallel`, whose
    queries begin fresh, must agree; views may be added behind its own.

    Raises:
        UsageError: the first shape that differs.
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
    """A policy of `settings` that begins with a copy of the weights of `init` and shares its statistics and words. Only
    the queries of a parallel target are fresh. A further view of `camera` begins with the first one's encoder, and the
    estimated positions do not depend on it yet."""
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
    """Word tokenizer over the instructions of all tasks of an environment."""
    return WordTokenizer.build(t.instruction for t in specs()[environment].tasks.values())
