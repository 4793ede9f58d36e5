"""Training runs, from settings to a folder on disk: the target, and the base of what drafts for it."""

from __future__ import annotations

import functools
import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from kerv_cli.base.durations import about
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.places import artifact, check_not_shipped, find_target
from kerv_cli.base.provenance import provenance_of
from kerv_cli.base.registry import find
from kerv_cli.base.runtime import set_up
from kerv_cli.base.views import views_of
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.episodes.runner import success_of
from kerv_cli.lab.runs import Curve
from kerv_cli.methods.artifacts import MadeFor, Weights, removal
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.targets.compact.folder import save_target
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.training.demonstrations import (
    check_spaces,
    check_tasks,
    demos_for,
    name_of,
    open_demos,
    seen_by,
    subset,
)
from kerv_cli.training.imitation import (
    Imitation,
    check_init,
    continued_target,
    load_samples,
    new_target,
    task_borders,
    vocabulary,
)
from kerv_cli.training.loop import Lesson, Loop, Metrics, check_same_run, stored_identity
from kerv_cli.training.settings import TrainDrafterSettings, TrainSettings, TrainTargetSettings
from kerv_cli.worlds import resolve_tasks, settled, spec_of
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress

RANGED = 200
"""Episodes from which the range of states is taken."""


def run_settings(train: TrainSettings) -> dict[str, Any]:
    """The optimisation settings that identify a run. Steps and the interval of validations may change on resuming, and
    `init` is identified by the hash of its weights instead of its name."""
    free = ("steps", "validate_every", "init", "stored")
    settings = {k: v for k, v in asdict(train).items() if k not in free}
    settings["closed_loop"] = train.closed_loop > 0  # scores with and without success do not compare
    return settings


def refuse_unused(train: TrainSettings, keys: Sequence[str], why: str) -> None:
    """Raises UsageError: one of the settings `keys`, which the run does not read, is not its default. why: behind the
    setting, in the message."""
    for key in keys:
        if (value := getattr(train, key)) != getattr(TrainSettings, key):
            raise UsageError(f"train.{key}={value}{why}")


class Run(ABC):
    """A training run: `load` makes the lesson, `train` optimises its module and saves the best checkpoint in `folder`.
    `plan` says in one line what would be done. borders: of `draw_samples`."""

    kind: str  # the word behind `kerv train`
    settings: TrainTargetSettings | TrainDrafterSettings
    dataset: DemoDataset
    folder: Path
    device: str
    learnt: Lesson
    borders: Tensor | None = None

    @property
    def folder_kind(self) -> str:
        """Kind of the artifact that is made."""
        return self.kind

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """What determines the run besides the optimisation settings and the demonstrations."""

    @abstractmethod
    def write(self, module: nn.Module, origin: dict[str, Any]) -> None:
        """Writes the weights and their description. origin: the provenance that the description holds."""

    def train(self, on_step: Callable[[int, Metrics], None]) -> Metrics:
        """Trains, resuming what the folder holds -> metrics of the best checkpoint. on_step(step, metrics).

        Raises:
            CheckpointError: the folder holds another run. KervError: training diverged. StorageError: writing failed.
        """
        self.learnt.module.train()
        keep = Curve.of(self.folder, self.settings.results).write
        loop = Loop(self.learnt, self.save, self.settings.train, self.folder, self.hash, self.borders, keep)
        return loop.run(on_step)

    @property
    def hash(self) -> str:
        """Of everything that determines the run."""
        parts = {"train": run_settings(self.settings.train), "demos": self.dataset.sha256, **self.identity()}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def check_folder(self, kind: str, key: str) -> None:
        """Refuses to go on with another run. kind: of artifact. key: the setting that names the folder.

        Raises:
            CheckpointError: the folder holds one.
        """
        stored = stored_identity(self.folder)
        if stored is not None:
            check_same_run(self.folder, stored, self.hash, f"choose another {key}=, or {removal(kind, self.folder)}")

    def save(self, module: nn.Module, metrics: Metrics) -> None:
        """Writes the weights with their provenance; metrics: of their validation."""
        figures = {
            "demos": {"sha256": self.dataset.sha256, "config": self.dataset.manifest.config},
            "validation": metrics,
            "parameters": sum(p.numel() for p in module.parameters()),
        }
        self.write(module, provenance_of(f"kerv train {self.kind}", self.settings, self.device, **figures))


class TargetRun(Run):
    """`kerv train target`. The constructor checks that the run is possible.

    Raises:
        UsageError: settings that do not fit together. CheckpointError: no such demonstrations or `train.init`,
            demonstrations of another environment, camera or tasks, another run in the folder.
    """

    kind = "target"
    settings: TrainTargetSettings

    def __init__(self, settings: TrainTargetSettings) -> None:
        self.settings = settings
        settings.demos = settings.demos or name_of(settings.task)
        self.dataset = open_demos(settings.results, settings.demos, settings.task)
        settings.task = settings.task or list(self.dataset.manifest.tasks)
        self.tasks = resolve_tasks(settings.task)
        self.check_places()
        self.spec = spec_of(self.tasks[0])
        self.world = settled(settings.world, self.spec)
        if settings.target.image_size != settings.world.camera.size:
            raise UsageError(
                f"target.image_size={settings.target.image_size} but world.camera.size={settings.world.camera.size}: "
                "the policy must be shown what it was trained on, set both alike"
            )
        self.folder = artifact(settings.results, "target", settings.name)
        self.init = self.find_init()
        camera = self.world.camera.name
        check_spaces(self.dataset, self.spec.actions, self.spec.observation, f"the tasks' environment {self.spec.name}")
        check_tasks(self.dataset, self.tasks)
        if settings.target.observation == "vision":
            shown = "the policy would be shown"
            self.dataset = seen_by(self.dataset, camera, shown, "set world.camera.name, or record again")
        # {"init": hash of its weights}; empty for a fresh run
        self.init_hash = {"init": read_target(self.init).sha256} if self.init else {}
        self.check_folder(self.kind, "name")

    def check_places(self) -> None:
        """Refuses what the position loss cannot learn from, and settings of images for a policy that sees none.

        Raises:
            UsageError: the first of them.
        """
        train, manifest = self.settings.train, self.dataset.manifest
        if not manifest.observation.places:
            raise UsageError(
                f"the demonstrations in {self.dataset.path} name no places (of object and goal): a compact policy "
                "cannot be trained on them"
            )
        if self.settings.target.observation == "state":
            refuse_unused(train, ("colour", "places"), " is of images, target.observation=state has none")
        recordings = [manifest.config, *manifest.config.get("joined", ())]
        if train.places == "path" and train.scene_weight and any(one.get("policy") for one in recordings):
            raise UsageError(
                "train.places=path: states that a policy visited lie on no path of the expert's: leave them out of "
                "demos=, or set train.places=state or train.scene_weight=0"
            )

    def find_init(self) -> Path | None:
        """Folder of the target `train.init`; None for a fresh run.

        Raises:
            UsageError: the run would overwrite it, or another shape. CheckpointError: no such target.
        """
        name, frozen = self.settings.train.init, self.settings.train.freeze
        if name is None:
            if frozen:
                raise UsageError(f"train.freeze={frozen}: fresh weights would stay as they are; set train.init too")
            return None
        folder = find_target(self.settings.results, name)
        if name == self.settings.name or folder.resolve() == self.folder.resolve():
            raise UsageError(
                f"train.init={name} would be overwritten by the run that begins with it: choose another name="
            )
        check_init(self.settings.target, self.world.camera.name, read_target(folder), folder)
        return folder

    def plan(self) -> str:
        """One line for --plan: demonstrations, tasks, steps, time and folder."""
        train, episodes = self.settings.train, [e for e in self.dataset.episodes if e.task in self.tasks]
        return (
            f"{self.folder}: {self.settings.target.size} on {self.settings.target.observation}, {len(episodes)} "
            f"demonstrations of {len(self.tasks)} tasks, {train.steps} steps of {train.batch} samples, "
            f"{about(self.seconds)}" + (f", beginning with {self.init}" if self.init else "")
        )

    @property
    def seconds(self) -> float:
        """A guess, from nano to small targets on one core: the trunk's weights, and the pixels of every view."""
        s, train = self.settings.target, self.settings.train
        weights = s.layers * s.width * (4 * s.width + 3 * s.feed_forward)
        views = len(views_of(self.world.camera.name)) if s.observation == "vision" else 0
        return train.steps * train.batch * (2.2e-9 * weights + 3e-4 * s.channels * views)

    def load(self, progress: OnProgress) -> None:
        """Reads the demonstrations and the weights of `train.init` into memory, and makes the target.

        Raises:
            CheckpointError: one of them is damaged or of another environment.
        """
        self.device, _ = set_up(self.settings.runtime)
        settings, camera, init = self.settings, self.world.camera.name, None
        if self.init is not None:
            init, description = load_target(self.init)
            check_spaces(self.dataset, description.actions, description.observation, f"the target in {self.init}")
        words = init.words if init else vocabulary(self.dataset.manifest.environment)
        samples = load_samples(self.dataset, settings.target, words, self.tasks, progress, settings.train.places)
        if init is None:
            target = new_target(settings.target, self.dataset, samples, words, camera, settings.train.seed)
        else:
            target = continued_target(settings.target, init, camera)
            modules = dict(target.named_children())
            for name in settings.train.freeze:
                if name not in modules:
                    raise UnknownName("train.freeze", name, modules)
                modules[name].requires_grad_(False)
        closed_loop = self.closed_loop if settings.train.closed_loop else None
        self.learnt = Imitation(target.to(self.device), samples, settings.train, closed_loop)
        self.borders = task_borders(self.learnt.training.tasks, settings.train.balance)

    def identity(self) -> dict[str, Any]:
        """Shapes, tasks, views and the weights to begin with."""
        shapes = asdict(self.settings.target)
        return {"target": shapes, "tasks": self.tasks, "views": self.dataset.views, **self.init_hash}

    def closed_loop(self, target: CompactTarget) -> float:
        """Success in [0, 1] of autoregressive decoding over the tasks, on selection seeds."""
        seeds = self.spec.seeds.selection[: self.settings.train.closed_loop]
        return success_of(target, self.tasks, seeds, self.world)

    def write(self, module: nn.Module, origin: dict[str, Any]) -> None:
        """Writes the target's folder."""
        assert isinstance(module, CompactTarget)
        environment = self.dataset.manifest.environment
        stored, states = self.settings.train.stored, self.state_range
        save_target(self.folder, module, environment, origin | self.init_hash, stored, states)

    @functools.cached_property
    def state_range(self) -> list[list[float]]:
        """[low, high], each (s,): percentiles 0.1 and 99.9 of every number of the state, over at most RANGED episodes,
        evenly chosen."""
        count = len(self.dataset.episodes)
        chosen = range(0, count, -(-count // RANGED))
        states = np.concatenate([self.dataset.load(index).states for index in chosen])
        ends: list[list[float]] = np.percentile(states, [0.1, 99.9], axis=0).tolist()
        return ends


class DrafterRun(Run):
    """Base of what `kerv train drafter` runs: weights that draft for a target, trained on demonstrations.

    artifact: the kind of what is written.

    Raises:
        UsageError: `train.init` is set. CheckpointError: no such target or demonstrations, another run in the folder.
    """

    kind = "drafter"
    artifact: Weights[Any]
    settings: TrainDrafterSettings
    target: ReadableTarget

    def __init__(self, settings: TrainDrafterSettings) -> None:
        if settings.train.freeze:
            raise UsageError(f"train.freeze={settings.train.freeze}: only 'kerv train target' keeps weights")
        of_targets = ("init", "balance", "closed_loop", "colour", "places")
        refuse_unused(settings.train, of_targets, ": only the training of a target has this setting")
        self.target_folder = find_target(settings.results, settings.policy.target)
        name = settings.policy.named(self.artifact.kind)
        self.folder = self.artifact.path(settings.results, name, self.target_folder)
        check_not_shipped(self.folder, f"policy.{self.artifact.kind}")
        self.settings, dataset = demos_for(settings)
        self.dataset = subset(dataset, self.settings.task)
        self.description = read_target(self.target_folder)
        self.description.check_autoregressive(
            f"policy.target={settings.policy.target}", "there are no greedy decodes to imitate"
        )
        self.check_folder(self.artifact.kind, f"policy.{self.artifact.kind}")

    @property
    def folder_kind(self) -> str:
        """Kind of the artifact that is made."""
        return self.artifact.kind

    @abstractmethod
    def lesson(self, progress: OnProgress) -> Lesson:
        """Reads the demonstrations through `target`: a fresh module and what it learns."""

    def summary(self) -> str:
        """What is trained and on what, for --plan."""
        s, what = self.settings.drafter, f"{self.artifact.noun} of {self.target_folder}"
        return f"{s.layers}-layer {what}, greedy decodes of {s.samples} observations"

    def plan(self) -> str:
        """One line for --plan: target, observations, steps, time and folder."""
        train = self.settings.train
        time = about(drafter_seconds(self.artifact.kind, train.steps))
        return f"{self.folder}: {self.summary()}, {train.steps} steps of {train.batch}, {time}"

    def load(self, progress: OnProgress) -> None:
        """Loads the target and reads the demonstrations.

        Raises:
            CheckpointError: target or demonstrations are damaged.
            UsageError: no such device.
        """
        self.device, _ = set_up(self.settings.runtime)
        self.target, _ = load_target(self.target_folder, self.device)
        self.learnt = self.lesson(progress)

    def identity(self) -> dict[str, Any]:
        """Return the shapes, the target's weights and the tasks."""
        s = self.settings
        tasks = list(resolve_tasks(s.task)) if s.task else []
        return {"drafter": asdict(s.drafter), "target": self.description.sha256, "task": tasks}

    def write(self, module: nn.Module, origin: dict[str, Any]) -> None:
        """Writes the drafter's folder."""
        made_for, stored = MadeFor.of(self.description), self.settings.train.stored
        self.artifact.save(self.folder, module, made_for, origin, stored, settings=asdict(self.settings.drafter))


def drafter_seconds(kind: str, steps: int) -> float:
    """Of training an artifact of this kind: a guess, from nano and small targets on one core."""
    return steps * {"scout": 0.4}.get(kind, 0.05)


def drafter_run(settings: TrainDrafterSettings) -> DrafterRun:
    """The training run of `drafter.kind`.

    Raises:
        UnknownName: no such kind. UsageError: settings of another kind.
    """
    part = find("drafter", settings.drafter.kind, "drafter.kind")
    if not isinstance(settings.drafter, part.settings):
        raise UsageError(f"drafter.kind={part.name}: choose drafter={part.name}, each has settings of its own")
    run: DrafterRun = part.built(settings)
    return run
