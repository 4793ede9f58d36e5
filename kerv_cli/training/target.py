"""`kerv train target`: train a compact policy by behaviour cloning.

A sample is one recorded control step: the observation, and the expert's next H actions without added noise. Policies
with the same token accuracy may differ widely in success. So with `train.closed_loop`, simulated episodes decide which
weights are best. Shapes: B samples of a batch, N tokens of a chunk, H control steps of a chunk, D DoFs of an action.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from kerv_cli.base.codes import CODES, FastCode
from kerv_cli.base.durations import count
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.paths import find_target, new_target
from kerv_cli.base.runtime import set_up
from kerv_cli.base.spaces import ActionSpace, Place
from kerv_cli.episodes.runner import success_of
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.targets.checkpoint import TargetDescription, load_target, read_target
from kerv_cli.targets.compact.features import WordTokenizer, places_of
from kerv_cli.targets.compact.target import CompactTarget, save_target
from kerv_cli.targets.losses import labels_of, position_loss, token_loss, within_chunk
from kerv_cli.targets.observations import Observations, read_chunks, read_observations, undisturbed
from kerv_cli.targets.samples import split
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.training import fit
from kerv_cli.training.demonstrations import check_spaces, check_tasks, name_of, open_demos, seen_by
from kerv_cli.training.settings import Plan, Stage, TrainSettings, TrainTargetSettings, refuse_unused
from kerv_cli.worlds import resolve_tasks, settled, spec_of, specs
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.files import DemoEpisode

STATE_EPISODES = 200  # maximum number of episodes from which the range of the states is measured
# Validation reports the share of tokens at most this many bins from the label. It is Spec-VLA's acceptance radius.
WITHIN = 9
# Positions that a policy estimates if its demonstrations hold no object positions: where the hand will be when the
# gripper next changes, and at the end of the episode. No state contains them, so their index 0 is never used.
WAYPOINTS = (Place("waypoint 1", 0), Place("waypoint 2", 0))
VALIDATED = 2048  # maximum number of samples in a validation


def plan_target(settings: TrainTargetSettings, database: Database) -> Plan[tuple[Path, fit.Metrics]]:
    """Check the settings of a training, and return the plan to train a compact policy or to go on with its training.

    Fills in `settings.demos`, `settings.task` and `settings.train.places`. `Plan.make` returns the target's folder and
    the metrics of the best weights.
    """
    folder, train = new_target(settings.results, settings.name), settings.train
    refuse_contradictions(settings)
    settings.demos = settings.demos or name_of(settings.task)
    dataset = open_demos(database, settings.demos, settings.task)
    settings.task = settings.task or list(dataset.manifest.tasks)
    tasks = resolve_tasks(settings.task)
    settle_places(settings, dataset)
    world = settled(settings.world, tasks)
    init = initial_target(settings, world.camera.name, folder)
    spec = spec_of(tasks[0])
    check_spaces(dataset, spec.actions, spec.observation, f"the tasks' environment {spec.name}")
    check_tasks(dataset, tasks)
    if settings.target.observation == "vision":
        dataset = seen_by(
            dataset, world.camera.name, "the policy would be shown", "set world.camera.name, or record again"
        )
    shapes = asdict(settings.target)
    if settings.target.code == "bins":  # left out, so that trainings from before there were codes can be resumed
        del shapes["code"]
    identity = fit.identity_of(train, dataset, target=shapes, tasks=tasks, views=dataset.views, **origin_of(init))
    begun = bool(command_to_go_on(database, "target", folder))
    place = fit.Destination(folder, identity, train.steps, "name", settings.replace, begun)
    start = f", starting from {init}" if init else ""
    text = (
        f"{settings.target.size} on {settings.target.observation}, "
        f"{count(len(dataset.of_tasks(*tasks)), 'demonstration')} of {count(len(tasks), 'task')}, "
        f"{count(train.steps, 'step')} of {train.batch} samples{start}"
    )

    def ready(dataset: DemoDataset, progress: OnProgress, undisturbed_only: bool = train.undisturbed) -> fit.Made:
        device, _ = set_up(settings.runtime)
        target, samples = load_training(settings, dataset, init, world.camera.name, progress, undisturbed_only)
        seeds = spec.seeds.selection[: train.closed_loop]
        success = functools.partial(success_of, tasks=tasks, seeds=seeds, settings=world) if seeds else None
        imitation = Imitation(target.to(device), samples, train, success)
        draw = fit.batches(len(imitation.training), train, imitation.weights)
        states = functools.cache(lambda: state_range(dataset))

        def write(folder: Path, target: CompactTarget, provenance: dict[str, Any]) -> None:
            made = provenance | origin_of(init)
            save_target(folder, target, dataset.manifest.environment, made, train.stored, states())

        return target, lambda step: imitation.loss(draw(step), step), imitation.validate, write

    def seconds() -> float:
        # from a few steps on demonstrations of one task; so few may all be disturbed, so all their chunks count
        chosen = [dataset.episodes[index] for index in dataset.of_tasks(tasks[0])]
        if train.undisturbed:
            chosen.sort(key=lambda episode: episode.perturbed)
        few = replace(dataset, episodes=chosen[: fit.FEW])
        target, loss, *_ = ready(few, lambda *done: None, undisturbed_only=False)
        return fit.seconds_of(loss, train, next(target.parameters()).device)

    def work(stage: Stage) -> tuple[Path, fit.Metrics]:
        return fit.train(settings, dataset, place, "kerv train target", "reading demonstrations", ready, stage)

    return Plan("target", folder, f"{folder}: {text}", work, place.check, seconds)


def origin_of(init: Path | None) -> dict[str, str]:
    return {"init": read_target(init).sha256} if init else {}


def refuse_contradictions(settings: TrainTargetSettings) -> None:
    shown, dtype = settings.world.camera.size, settings.runtime.dtype
    if dtype != "float32":
        raise UsageError(f"runtime.dtype={dtype}: a target is trained in float32; remove runtime.dtype")
    if settings.target.image_size != shown:
        raise UsageError(
            f"target.image_size={settings.target.image_size} but world.camera.size={shown}: "
            "the policy must be shown what it was trained on, set both alike"
        )


def settle_places(settings: TrainTargetSettings, dataset: DemoDataset) -> None:
    """Choose the positions that the policy learns to estimate, and check that the demonstrations hold them."""
    train, manifest = settings.train, dataset.manifest
    where = f"the demonstrations in {dataset.path}"
    if settings.target.observation == "state":
        if not manifest.observation.places:
            raise UsageError(
                f"{where} hold no object positions, which target.observation=state reads: set target.observation=vision"
            )
        refuse_unused(train, ("colour", "places"), " needs images, and target.observation=state has none")
    if not manifest.observation.places:
        if len(manifest.observation.proprioception) < 3:
            raise CheckpointError(f"{where} do not hold the hand's position: import data with observation.state")
        if train.places == "state":
            train.places = "path"
            print(f"{where} hold no object positions: train.places=path", file=sys.stderr)
    recordings = [manifest.config, *manifest.config.get("joined", ())]
    if train.places == "path" and train.scene_weight and any(one.get("policy") for one in recordings):
        raise UsageError(
            "train.places=path learns from the expert's paths, but a policy acted in some of these demonstrations: "
            "leave those out of demos=, or set train.places=state or train.scene_weight=0"
        )


def initial_target(settings: TrainTargetSettings, camera: str, new: Path) -> Path | None:
    name = settings.train.init
    if name is None:
        return None
    folder = find_target(settings.results, name)
    if folder.resolve() == new.resolve():
        raise UsageError(f"train.init={name} would be overwritten: choose another name=")
    check_init(settings.target, camera, read_target(folder), folder)
    return folder


def load_training(
    settings: TrainTargetSettings,
    dataset: DemoDataset,
    init: Path | None,
    camera: str,
    progress: OnProgress,
    undisturbed_only: bool,
) -> tuple[CompactTarget, Samples]:
    """Read the demonstrations into memory, and make the network, with the weights in `init` if that is not None."""
    manifest, shapes, old = dataset.manifest, settings.target, None
    words, observation = vocabulary(manifest.environment), manifest.observation
    if init is not None:
        old, description = load_target(init)
        check_spaces(dataset, description.actions, description.observation, f"the target in {init}")
        words, observation = old.words, old.observation
    elif not observation.places:
        observation = observation.without_state(WAYPOINTS)
    waypoints = len(observation.places) if settings.train.places == "path" else 0
    tasks = resolve_tasks(settings.task)
    samples = load_samples(dataset, shapes, words, tasks, progress, waypoints, undisturbed_only)
    torch.manual_seed(settings.train.seed)
    if old is None:
        actions = manifest.actions.fitted(samples.chunks[:, 0].numpy().astype(np.float64))
        code = CODES[shapes.code](actions.normalise(samples.chunks.numpy()))
        return CompactTarget(replace(shapes), replace(actions, code=code), observation, words, camera), samples
    code = old.actions.code
    if (old.settings.code, old.chunk) != (shapes.code, shapes.chunk):
        code = CODES[shapes.code](old.actions.normalise(samples.chunks.numpy()))
    return continued_target(shapes, old, camera, code), samples


def state_range(dataset: DemoDataset) -> list[list[float]]:
    """Return the 0.1th and the 99.9th percentiles of the s numbers of a state, over at most STATE_EPISODES episodes."""
    count = len(dataset.episodes)
    states = np.concatenate([dataset.load(i).states for i in range(0, count, -(-count // STATE_EPISODES))])
    ends: list[list[float]] = np.percentile(states, [0.1, 99.9], axis=0).tolist()
    return ends


@dataclass(frozen=True)
class Samples(Observations):
    """The n samples that a policy is trained on: observations and the expert's chunks."""

    chunks: Tensor  # (n, H, D) float32, the expert's actions without added noise, environment units
    places: Tensor  # (n, K, 3) float32, the positions that the target learns to estimate, metres
    episodes: Tensor  # (n,) int64, index of the sample's episode
    tasks: Tensor  # (n,) int64, index of the sample's task


def load_samples(
    dataset: DemoDataset,
    settings: TargetSettings,
    words: WordTokenizer,
    task_names: tuple[str, ...],
    progress: OnProgress = lambda done, total: None,
    waypoints: int = 0,
    undisturbed_only: bool = False,
) -> Samples:
    chosen, parts = dataset.of_tasks(*task_names), list[Samples]()
    for number, index in enumerate(chosen):
        episode = dataset.load(index)
        observations = read_observations(episode, settings, dataset.manifest.observation, words)
        if undisturbed_only:
            kept = undisturbed(episode, observations.steps.numpy(), settings.chunk)
            observations = observations.where(torch.from_numpy(kept))
        steps, count = observations.steps.numpy(), len(observations)
        if waypoints:
            learnt = waypoints_of(episode, steps, waypoints, dataset.manifest.actions)
        else:
            learnt = places_of(observations.states, dataset.manifest.observation)
        if count:
            parts.append(
                Samples(
                    **vars(observations),
                    chunks=torch.from_numpy(read_chunks(episode, steps, settings.chunk)).float(),
                    places=learnt,
                    episodes=torch.full((count,), len(parts)),
                    tasks=torch.full((count,), task_names.index(episode.task)),
                )
            )
        progress(number + 1, len(chosen))
    learnt_tasks = {int(part.tasks[0]) for part in parts}
    for number, task in enumerate(task_names):
        if undisturbed_only and number not in learnt_tasks:
            raise CheckpointError(
                f"every chunk of {task} was disturbed: record it with quiet={2 * settings.chunk}, or leave "
                "train.undisturbed out"
            )
    return Samples.joined(parts)


def waypoints_of(episode: DemoEpisode, steps: np.ndarray, count: int, actions: ActionSpace) -> Tensor:
    """Return where the hand will be at the next K − 1 gripper changes and at the end: (n, K, 3) float32, metres.

    A gripper change is a control step in which the expert's command of a strict DoF moves by more than an eighth of its
    range. No simulator state is needed.

    Args:
        steps: (n,) control steps.
        count: K, number of positions.
    """
    commands = episode.labels[: episode.steps, actions.is_strict]
    changes = np.flatnonzero((abs(np.diff(commands, axis=0)) > actions.half[actions.is_strict] / 4).any(-1)) + 1
    last = episode.steps - 1
    times = np.append(changes, [last] * count)
    first = np.searchsorted(changes, steps, side="right")
    reached = np.concatenate([times[first[:, None] + np.arange(count - 1)], np.full((len(steps), 1), last)], 1)
    return torch.from_numpy(episode.end_effector[reached]).float()


def task_weights(tasks: Tensor, balance: float) -> Tensor | None:
    """Return a weight per sample, (n,) float64, with which samples are drawn. None if all are equally likely.

    A task with the share p of the samples is drawn in proportion to p^(1 − balance). `tasks` (n,) are task indices.
    """
    if balance == 0:
        return None
    shares = torch.bincount(tasks).double() / len(tasks)
    weights: Tensor = shares[tasks] ** -balance
    return weights


def lit(images: Tensor, indices: Tensor, step: int, spread: float) -> Tensor:
    """Change the light on images (B, 3, h, w) uint8 at random, as data augmentation.

    Each colour channel is multiplied by the exponential of a smooth random field. The field's standard deviation is
    drawn uniformly from 0 to `spread` for each image. Step and `indices` (B,) of the samples determine the fields.
    """
    fields = []
    for index in indices.tolist():
        random = np.random.default_rng((step, index))
        fields.append(spread * random.uniform() * random.normal(size=(3, 3, 3)))
    factors = torch.from_numpy(np.stack(fields)).float().to(images.device).exp()
    light = F.interpolate(factors, images.shape[-2:], mode="bilinear", align_corners=True)
    return (images * light).round_().clamp_(0, 255).to(torch.uint8)


class Imitation:
    """A target's samples, its loss and its validation."""

    def __init__(
        self,
        target: CompactTarget,
        samples: Samples,
        settings: TrainSettings,
        closed_loop: Callable[[CompactTarget], float] | None = None,
    ) -> None:
        self.module, self.settings, self.device, self.closed_loop = target, settings, target.device, closed_loop
        self.training, self.held_out = split(samples, settings.held_out)
        self.labels = labels_of(target.actions, settings.label_sigma).to(self.device)
        self.weights = task_weights(self.training.tasks, settings.balance)
        self.learns_places = bool(target.cameras and settings.scene_weight)
        gpu = self.device.type != "cpu"
        # CPUs without AMX or AVX512-BF16 are slower in bfloat16
        multiplies = gpu or torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported()
        self.bf16 = settings.bf16 and multiplies
        self.kernels = [SDPBackend.MATH]
        if gpu or not self.bf16:  # on a CPU, the backward pass of a fused kernel in bfloat16 takes four times as long
            self.kernels += [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION]

    def tokens(self, batch: Samples) -> Tensor:
        tokens = self.module.actions.chunk_tokens(batch.chunks.numpy())
        lengths = (tokens != self.module.actions.end).sum(1) + 1
        return torch.from_numpy(tokens[:, : lengths.max()]).to(self.device)

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, fit.Metrics]:
        """Return the loss of the samples `indices` (B,), and the metrics to log."""
        batch = self.training.where(indices)
        inputs = batch.inputs(self.device)
        if self.settings.colour and inputs.images is not None:
            inputs = replace(inputs, images=lit(inputs.images, indices, step, self.settings.colour))
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16), sdpa_kernel(self.kernels):
            places = batch.places.to(self.device)
            if self.learns_places and step < self.settings.scene_steps:
                loss = position_loss(self.module.encode_batch(inputs)[1], places)
                return loss, {"position_loss": float(loss.detach())}
            tokens = self.tokens(batch)
            logits, positions = self.module.teacher_forced(inputs, tokens)
            end = self.module.actions.end
            loss = token_loss(logits, tokens, self.labels, None if end is None else within_chunk(tokens, end))
            metrics = {"token_loss": float(loss.detach())}
            if self.learns_places:
                of_places = position_loss(positions, places)
                loss = loss + self.settings.scene_weight * of_places
                metrics["position_loss"] = float(of_places.detach())
        return loss, metrics

    @torch.no_grad()
    def validate(self, module: nn.Module) -> fit.Metrics:
        """Return metrics on the held-out episodes, with teacher forcing.

        The score is minus the mean absolute error of the actions, plus ten times the closed-loop success if it is
        measured.
        """
        assert isinstance(module, CompactTarget)
        chosen = torch.linspace(0, len(self.held_out) - 1, min(VALIDATED, len(self.held_out))).long()
        distances, gaps, offsets = [], [], []
        actions = module.actions
        for indices in chosen.split(256):
            batch = self.held_out.where(indices)
            tokens = self.tokens(batch)
            logits, positions = module.teacher_forced(batch.inputs(self.device), tokens)
            guess = logits.argmax(-1)
            distances.append((guess - tokens).abs()[within_chunk(tokens, actions.end)])
            for guessed, expert in zip(guess.tolist(), tokens.tolist(), strict=True):
                values = actions.chunk_values(guessed, module.chunk)
                gaps.append(np.abs(values - actions.chunk_values(expert, module.chunk)))
            offsets.append((positions - batch.places.to(self.device)).norm(dim=-1))
        distance, error = torch.cat(distances), np.concatenate(gaps).mean(0)
        metrics = {
            "score": -float(error.mean()),
            "token_accuracy": float((distance == 0).float().mean()),
            f"within_{WITHIN}": float((distance <= WITHIN).float().mean()),
            "action_l1": float(error.mean()),
        }
        metrics |= {f"l1_{name}": float(one) for name, one in zip(actions.names, error, strict=True)}
        if self.learns_places:
            medians = torch.cat(offsets).median(0).values.tolist()
            for number, place in enumerate(module.observation.places):
                of_path = self.settings.places == "path"
                name = f"waypoint_{number + 1}" if of_path else place.name.replace(" ", "_")
                metrics[f"{name}_error_cm"] = 100 * medians[number]
        if self.closed_loop is not None:
            metrics["closed_loop_success"] = self.closed_loop(module)
            metrics["score"] += 10 * metrics["closed_loop_success"]
        return metrics


def check_init(settings: TargetSettings, camera: str, description: TargetDescription, folder: Path) -> None:
    """Refuse initial weights of other shapes. Only size, chunk, code, norm and parallel may differ.

    The new target may see further camera views after the views of the old target.
    """
    for name, value in asdict(settings).items():
        stored = description.settings.get(name)
        if name not in ("size", "chunk", "code", "parallel", "norm") and stored != value:
            raise UsageError(
                f"train.init: the target in {folder} has {name}={stored}, the run target.{name}={value}: set both alike"
            )
    trained = description.cameras[0] if description.cameras else ""
    if settings.observation == "vision" and not f"{camera}+".startswith(f"{trained}+"):
        raise UsageError(
            f"train.init: the target in {folder} sees {trained}, the run {camera}: world.camera.name must be "
            f"{trained}, or begin with {trained}+"
        )


def continued_target(
    settings: TargetSettings, init: CompactTarget, camera: str, code: FastCode | None = None
) -> CompactTarget:
    """Make a target that starts from the weights, action statistics and vocabulary of another target."""
    actions = replace(init.actions, code=code)
    target = CompactTarget(replace(settings), actions, init.observation, init.words, camera)
    new, old = target.state_dict(), init.state_dict()
    kept = old.keys() if actions == init.actions else old.keys() - {"embedding.weight", "head.weight"}
    kept = {name for name in kept & new.keys() if name != "queries" or old[name].shape == new[name].shape}
    weights = new | {name: old[name] for name in kept}
    if target.cameras:
        for view in range(len(init.encoders) - 1, len(target.encoders) - 1):
            for name, value in init.vision.state_dict().items():
                weights[f"further_views.{view}.{name}"] = value
        points = 2 * settings.keypoints * len(init.encoders)
        added = 2 * settings.keypoints * len(target.encoders) - points
        weight = weights["locate.0.weight"]
        columns = [weight[:, :points], weight.new_zeros(len(weight), added), weight[:, points:]]
        weights["locate.0.weight"] = torch.cat(columns, 1)
    target.load_state_dict(weights)
    return target


def vocabulary(environment: str) -> WordTokenizer:
    return WordTokenizer.build(t.instruction for t in specs()[environment].tasks.values())
