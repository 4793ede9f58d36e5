"""`kerv train target`: train a compact policy by behaviour cloning."""

from __future__ import annotations

import functools
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from kerv_cli.base.durations import count
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.places import artifact
from kerv_cli.base.runtime import set_up
from kerv_cli.episodes.runner import success_of
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.targets.compact.folder import save_target
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.folders import find_target
from kerv_cli.training.demonstrations import check_spaces, check_tasks, name_of, open_demos, seen_by
from kerv_cli.training.imitation import (
    WAYPOINTS,
    Imitation,
    check_init,
    continued_target,
    load_samples,
    vocabulary,
)
from kerv_cli.training.run import TrainingRun, refuse_unused
from kerv_cli.training.settings import TrainTargetSettings
from kerv_cli.worlds import resolve_tasks, settled, spec_of
from kerv_cli.worlds.demos.dataset import OnProgress

STATE_EPISODES = 200
"""Maximum number of episodes from which the range of the states is measured."""


class TargetRun(TrainingRun):
    """The training of a compact policy, by `kerv train target`.

    Attributes:
        notes: One line for each setting that was changed to suit the demonstrations.

    Raises:
        UsageError: Some settings contradict each other.
        CheckpointError: The demonstrations or the target `train.init` do not exist. Or the demonstrations have another
            environment, camera or other tasks. Or the folder holds another training.
    """

    kind = artifact_kind = "target"
    settings: TrainTargetSettings

    def __init__(self, settings: TrainTargetSettings) -> None:
        self.settings = settings
        self.folder = artifact(settings.results, "target", settings.name)
        if settings.runtime.dtype != "float32":
            raise UsageError(
                f"runtime.dtype={settings.runtime.dtype}: a target is trained in float32; remove runtime.dtype"
            )
        settings.demos = settings.demos or name_of(settings.task)
        self.dataset = open_demos(settings.results, settings.demos, settings.task)
        settings.task = settings.task or list(self.dataset.manifest.tasks)
        self.tasks = resolve_tasks(settings.task)
        self.notes: list[str] = []
        self.check_places()
        self.spec = spec_of(self.tasks[0])
        self.world = settled(settings.world, self.spec)
        if settings.target.image_size != settings.world.camera.size:
            raise UsageError(
                f"target.image_size={settings.target.image_size} but world.camera.size={settings.world.camera.size}: "
                "the policy must be shown what it was trained on, set both alike"
            )
        self.init = self.find_init()
        camera = self.world.camera.name
        check_spaces(self.dataset, self.spec.actions, self.spec.observation, f"the tasks' environment {self.spec.name}")
        check_tasks(self.dataset, self.tasks)
        if settings.target.observation == "vision":
            shown = "the policy would be shown"
            self.dataset = seen_by(self.dataset, camera, shown, "set world.camera.name, or record again")
        # {"init": hash of the initial weights}; empty without train.init
        self.init_hash = {"init": read_target(self.init).sha256} if self.init else {}
        self.check_folder("name")

    def check_places(self) -> None:
        """Check that the demonstrations hold the positions that the policy reads or learns to estimate.

        Without object positions, change `train.places` from `state` to `path`, and add a note. The policy then learns
        where the hand will be.

        Raises:
            UsageError: The policy reads object positions, and the demonstrations hold none. Or `train.places=path` is
                chosen but a policy acted in some demonstrations. Or a setting needs images and the policy has none.
            CheckpointError: The demonstrations hold neither the objects' positions nor the hand's.
        """
        train, manifest = self.settings.train, self.dataset.manifest
        where = f"the demonstrations in {self.dataset.path}"
        if self.settings.target.observation == "state":
            if not manifest.observation.places:
                raise UsageError(
                    f"{where} hold no object positions, which target.observation=state reads: "
                    "set target.observation=vision"
                )
            refuse_unused(train, ("colour", "places"), " needs images, and target.observation=state has none")
        if not manifest.observation.places:
            if len(manifest.observation.proprioception) < 3:
                raise CheckpointError(f"{where} do not hold the hand's position: import data with observation.state")
            if train.places == "state":
                train.places = "path"
                self.notes.append(f"{where} hold no object positions: train.places=path")
        recordings = [manifest.config, *manifest.config.get("joined", ())]
        if train.places == "path" and train.scene_weight and any(one.get("policy") for one in recordings):
            raise UsageError(
                "train.places=path learns from the expert's paths, but a policy acted in some of these demonstrations: "
                "leave those out of demos=, or set train.places=state or train.scene_weight=0"
            )

    def find_init(self) -> Path | None:
        """Return the folder of the target whose weights training starts from; None without `train.init`.

        Raises:
            UsageError: The training would overwrite that target, or its shapes differ.
            CheckpointError: That target does not exist.
        """
        name = self.settings.train.init
        if name is None:
            return None
        folder = find_target(self.settings.results, name)
        if folder.resolve() == self.folder.resolve():
            raise UsageError(f"train.init={name} would be overwritten: choose another name=")
        check_init(self.settings.target, self.world.camera.name, read_target(folder), folder)
        return folder

    def plan(self) -> str:
        """Return one line that `--plan` prints: demonstrations, tasks, number of steps and folder."""
        target, train = self.settings.target, self.settings.train
        episodes = [episode for episode in self.dataset.episodes if episode.task in self.tasks]
        return (
            f"{self.folder}: {target.size} on {target.observation}, {count(len(episodes), 'demonstration')} of "
            f"{count(len(self.tasks), 'task')}, {count(train.steps, 'step')} of {train.batch} samples"
            + (f", starting from {self.init}" if self.init else "")
        )

    def load(self, progress: OnProgress) -> None:
        """Read the demonstrations into memory, and make the network, from the weights of `train.init` if it is set.

        Raises:
            CheckpointError: The demonstrations or the target `train.init` are damaged or of another environment.
        """
        self.device, _ = set_up(self.settings.runtime)
        settings, camera, init = self.settings, self.world.camera.name, None
        if self.init is not None:
            init, description = load_target(self.init)
            check_spaces(self.dataset, description.actions, description.observation, f"the target in {self.init}")
        words = init.words if init else vocabulary(self.dataset.manifest.environment)
        recorded = self.dataset.manifest.observation
        fresh = recorded if recorded.places else recorded.without_state(WAYPOINTS)
        observation = fresh if init is None else init.observation
        waypoints = len(observation.places) if settings.train.places == "path" else 0
        samples = load_samples(self.dataset, settings.target, words, self.tasks, progress, waypoints)
        if init is None:
            torch.manual_seed(settings.train.seed)
            actions = self.dataset.manifest.actions.fitted(samples.chunks[:, 0].numpy().astype(np.float64))
            target = CompactTarget(replace(settings.target), actions, observation, words, camera)
        else:
            target = continued_target(settings.target, init, camera)
        seeds = self.spec.seeds.selection[: settings.train.closed_loop]
        success = functools.partial(success_of, tasks=self.tasks, seeds=seeds, settings=self.world) if seeds else None
        self.objective = Imitation(target.to(self.device), samples, settings.train, success)

    def identity(self) -> dict[str, Any]:
        """Return the shapes, the tasks, the camera views and the hash of the initial weights."""
        shapes = asdict(self.settings.target)
        return {"target": shapes, "tasks": self.tasks, "views": self.dataset.views, **self.init_hash}

    def write(self, module: nn.Module, provenance: dict[str, Any]) -> None:
        """Write the weights and their description into the target's folder."""
        assert isinstance(module, CompactTarget)
        environment, stored = self.dataset.manifest.environment, self.settings.train.stored
        save_target(self.folder, module, environment, provenance | self.init_hash, stored, self.state_range)

    @functools.cached_property
    def state_range(self) -> list[list[float]]:
        """Range of each of the s numbers of a state: the 0.1th percentiles (s,), then the 99.9th percentiles (s,).

        They are measured on at most STATE_EPISODES episodes.
        """
        count = len(self.dataset.episodes)
        chosen = range(0, count, -(-count // STATE_EPISODES))
        states = np.concatenate([self.dataset.load(index).states for index in chosen])
        ends: list[list[float]] = np.percentile(states, [0.1, 99.9], axis=0).tolist()
        return ends
