"""`kerv train target`: train a compact policy by behaviour cloning."""

from __future__ import annotations

import functools
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.codes import CODES
from kerv_cli.base.durations import count
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.paths import artifact, find_target
from kerv_cli.base.runtime import set_up
from kerv_cli.episodes.runner import success_of
from kerv_cli.lab.database import Database
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.targets.compact.target import CompactTarget, save_target
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import check_spaces, check_tasks, name_of, open_demos, seen_by
from kerv_cli.training.fit import Metrics, batches, figures_of, fit, identity_of, refuse_other, without_subnormals
from kerv_cli.training.imitation import (
    WAYPOINTS,
    Imitation,
    Samples,
    check_init,
    continued_target,
    load_samples,
    vocabulary,
)
from kerv_cli.training.settings import Begin, TrainTargetSettings, quietly, refuse_unused
from kerv_cli.worlds import resolve_tasks, settled, spec_of
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress

STATE_EPISODES = 200
"""Maximum number of episodes from which the range of the states is measured."""


def train_target(settings: TrainTargetSettings, database: Database, begin: Begin = quietly) -> tuple[Path, Metrics]:
    """Train a compact policy. If its folder holds a resume file, continue that training.

    Args:
        settings: Settings of `kerv train target`. This function fills in `demos`, `task` and `train.places`.
        database: The database of the results folder.
        begin: Called once all settings are checked.

    Returns:
        The target's folder, and the metrics of the best weights.

    Raises:
        UsageError: Some settings contradict each other.
        CheckpointError: The demonstrations or the target `train.init` do not exist or are damaged. Or the
            demonstrations have another environment, camera or other tasks. Or the folder holds another training.
        KervError: The training diverged.
    """
    folder, train = artifact(settings.results, "target", settings.name), settings.train
    refuse_contradictions(settings)
    settings.demos = settings.demos or name_of(settings.task)
    dataset = open_demos(database, settings.demos, settings.task)
    settings.task = settings.task or list(dataset.manifest.tasks)
    tasks = resolve_tasks(settings.task)
    settle_places(settings, dataset)
    spec = spec_of(tasks[0])
    world = settled(settings.world, spec)
    init = initial_target(settings, world.camera.name, folder)
    check_spaces(dataset, spec.actions, spec.observation, f"the tasks' environment {spec.name}")
    check_tasks(dataset, tasks)
    if settings.target.observation == "vision":
        remedy = "set world.camera.name, or record again"
        dataset = seen_by(dataset, world.camera.name, "the policy would be shown", remedy)
    origin = {"init": read_target(init).sha256} if init else {}
    shapes = asdict(settings.target)
    if settings.target.code == "bins":  # left out, so that trainings from before there were codes can be resumed
        del shapes["code"]
    identity = identity_of(train, dataset, target=shapes, tasks=tasks, views=dataset.views, **origin)
    refuse_other(folder, identity, "target", "name")

    episodes = len(dataset.of_tasks(*tasks))
    start = f", starting from {init}" if init else ""
    plan = (
        f"{settings.target.size} on {settings.target.observation}, {count(episodes, 'demonstration')} of "
        f"{count(len(tasks), 'task')}, {count(train.steps, 'step')} of {train.batch} samples{start}"
    )

    stage = begin("target", folder, f"{folder}: {plan}", train.steps)
    device, _ = set_up(settings.runtime)
    with without_subnormals():
        with stage("reading demonstrations") as progress:
            target, samples = load_training(settings, dataset, tasks, init, world.camera.name, progress)
        seeds = spec.seeds.selection[: train.closed_loop]
        success = functools.partial(success_of, tasks=tasks, seeds=seeds, settings=world) if seeds else None
        imitation = Imitation(target.to(device), samples, train, success)
        draw = batches(len(imitation.training), train, imitation.weights)
        states = functools.cache(lambda: state_range(dataset))

        def loss(step: int) -> tuple[Tensor, Metrics]:
            return imitation.loss(draw(step), step)

        def save(target: CompactTarget, metrics: Metrics) -> None:
            figures = figures_of(dataset, target, metrics)
            provenance = provenance_of("kerv train target", settings, device, **figures) | origin
            save_target(folder, target, dataset.manifest.environment, provenance, train.stored, states())

        with stage("training the target") as progress:
            return folder, fit(target, loss, imitation.validate, save, train, folder, identity, progress)


def refuse_contradictions(settings: TrainTargetSettings) -> None:
    """Check the number format and the image size of a training.

    Raises:
        UsageError: `runtime.dtype` is not float32, or the policy's image size differs from the camera's.
    """
    shown, dtype = settings.world.camera.size, settings.runtime.dtype
    if dtype != "float32":
        raise UsageError(f"runtime.dtype={dtype}: a target is trained in float32; remove runtime.dtype")
    if settings.target.image_size != shown:
        raise UsageError(
            f"target.image_size={settings.target.image_size} but world.camera.size={shown}: "
            "the policy must be shown what it was trained on, set both alike"
        )


def settle_places(settings: TrainTargetSettings, dataset: DemoDataset) -> None:
    """Check that the demonstrations hold the positions that the policy reads or learns to estimate.

    Without object positions, change `train.places` from `state` to `path`, and say so. The policy then learns where the
    hand will be.

    Raises:
        UsageError: The policy reads object positions, and the demonstrations hold none. Or `train.places=path` is
            chosen but a policy acted in some demonstrations. Or a setting needs images and the policy has none.
        CheckpointError: The demonstrations hold neither the objects' positions nor the hand's.
    """
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
    """Return the folder of the target whose weights training starts from. None if `train.init` is not set.

    Args:
        settings: Settings of the training.
        camera: Name of the camera.
        new: Folder of the new target.

    Raises:
        UsageError: The training would overwrite that target, or that target has other shapes than the new one.
        CheckpointError: The target `train.init` does not exist.
    """
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
    tasks: tuple[str, ...],
    init: Path | None,
    camera: str,
    progress: OnProgress,
) -> tuple[CompactTarget, Samples]:
    """Read the demonstrations into memory, and make the network. It starts from the weights of `init` if given.

    Raises:
        CheckpointError: The demonstrations or the target `init` are damaged or of another environment.
    """
    manifest, shapes, old = dataset.manifest, settings.target, None
    if init is not None:
        old, description = load_target(init)
        check_spaces(dataset, description.actions, description.observation, f"the target in {init}")
    words, observation = vocabulary(manifest.environment), manifest.observation
    if old is not None:
        words, observation = old.words, old.observation
    elif not observation.places:
        observation = observation.without_state(WAYPOINTS)
    waypoints = len(observation.places) if settings.train.places == "path" else 0
    samples = load_samples(dataset, shapes, words, tasks, progress, waypoints)
    torch.manual_seed(settings.train.seed)
    if old is not None:
        actions = old.actions
    else:
        actions = manifest.actions.fitted(samples.chunks[:, 0].numpy().astype(np.float64))
    if old is not None and (old.settings.code, old.chunk) == (shapes.code, shapes.chunk):
        code = old.actions.code
    else:
        code = CODES[shapes.code](actions.normalise(samples.chunks.numpy()))
    if old is not None:
        return continued_target(shapes, old, camera, code), samples
    return CompactTarget(replace(shapes), replace(actions, code=code), observation, words, camera), samples


def state_range(dataset: DemoDataset) -> list[list[float]]:
    """Return the range of each of the s numbers of a state: two lists of s percentiles, the 0.1th and the 99.9th.

    The percentiles are measured on at most STATE_EPISODES episodes.
    """
    count = len(dataset.episodes)
    chosen = range(0, count, -(-count // STATE_EPISODES))
    states = np.concatenate([dataset.load(index).states for index in chosen])
    ends: list[list[float]] = np.percentile(states, [0.1, 99.9], axis=0).tolist()
    return ends
