"""A training run from settings to a folder on disk: what is read, where it is saved, what is written down about it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from kerv_cli.artifacts import artifact_folder
from kerv_cli.drafting.eagle import Drafter, save_drafter
from kerv_cli.drafting.early import EarlyDrafter, save_early
from kerv_cli.environments import resolve_tasks
from kerv_cli.environments.demos.dataset import DemoDataset
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.places import artifact, find_target
from kerv_cli.provenance import provenance
from kerv_cli.runtime import set_up
from kerv_cli.settings import EVALUATION_SEED, TrainDrafterSettings, TrainSettings, TrainTargetSettings
from kerv_cli.targets.checkpoint import load_target, read_target, save_target
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.training.distillation import Distillation, distillation_job, teach
from kerv_cli.training.early_distillation import EarlyDistillation, early_job, teach_early
from kerv_cli.training.imitation import (
    Imitation,
    Samples,
    check_init,
    check_spaces,
    continued_target,
    imitation_job,
    load_samples,
    new_target,
    split,
    vocabulary,
)
from kerv_cli.training.loop import Job, Loop, Metrics

Progress = Callable[[int, int], None]
VALIDATION_SEED = EVALUATION_SEED // 2
"""First seed of closed-loop validation: neither a training seed nor an evaluation seed."""


def determining(train: TrainSettings) -> dict[str, Any]:
    """What of the optimisation settings makes two runs different. A run may be resumed with more or fewer steps.
    `init` is a name: the weights that it stands for count."""
    return {
        k: v for k, v in asdict(train).items() if k not in ("steps", "validate_every", "closed_loop", "init", "half")
    }


def identity_of(**parts: Any) -> str:
    """Hash of everything that determines a run's next step."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


class TargetRun:
    """`kerv train target`."""

    def __init__(self, settings: TrainTargetSettings) -> None:
        self.settings = settings
        self.tasks = resolve_tasks(settings.task)
        if settings.target.observation not in ("vision", "state"):
            raise UsageError(f"target.observation={settings.target.observation}: vision or state")
        if settings.target.image_size != settings.world.camera.size:
            raise UsageError(
                f"target.image_size={settings.target.image_size} but world.camera.size={settings.world.camera.size}: "
                "the policy must be shown what it was trained on, set both alike"
            )
        self.folder = artifact(settings.results, "target", settings.name)
        self.init = self.find_init()
        self.dataset = DemoDataset.open(artifact(settings.results, "demos", settings.demos))
        self.samples: Samples | None = None
        self.begun: CompactTarget | None = None
        self.origin: dict[str, str] = {}  # hash of the weights that the run begins with, where they are not fresh

    def find_init(self) -> Path | None:
        """The folder of the target that the run begins with."""
        name = self.settings.train.init
        if name is None:
            return None
        folder = find_target(self.settings.results, name)
        if name == self.settings.name or folder.resolve() == self.folder.resolve():
            raise UsageError(
                f"train.init={name} would be overwritten by the run that begins with it: choose another name="
            )
        check_init(self.settings.target, read_target(folder), folder)
        return folder

    def plan(self) -> str:
        """One line: what the run would do."""
        train, episodes = self.settings.train, [e for e in self.dataset.episodes if e.task in self.tasks]
        return (
            f"{self.folder}: {self.settings.target.size} on {self.settings.target.observation}, {len(episodes)} "
            f"demonstrations of {len(self.tasks)} tasks, {train.steps} steps of {train.batch} samples"
            + (f", beginning with {self.init}" if self.init else "")
        )

    def load(self, progress: Progress) -> None:
        """Read the demonstrations, and the weights to begin with."""
        self.device, _ = set_up(self.settings.runtime)
        if self.init is not None:
            self.begun, described = load_target(self.init)
            assert self.begun is not None
            self.origin = {"init": described.sha256}
            check_spaces(self.begun, self.dataset)
        words = self.begun.words if self.begun else vocabulary(self.dataset.manifest.environment)
        self.samples = load_samples(self.dataset, self.settings.target, words, self.tasks, progress)

    def train(self, on_step: Callable[[int, Metrics], None]) -> Metrics:
        """Train, resuming what is there -> metrics of the best checkpoint."""
        assert self.samples is not None
        settings = self.settings
        if self.begun is None:
            camera = settings.world.camera.name
            words = vocabulary(self.dataset.manifest.environment)
            target = new_target(settings.target, self.dataset, self.samples, words, camera, settings.train.seed)
        else:
            target = continued_target(settings.target, self.begun)
        target = target.to(self.device)
        identity = identity_of(
            target=asdict(settings.target),
            train=determining(settings.train),
            demos=self.dataset.sha256,
            tasks=self.tasks,
            **self.origin,
        )
        run = Imitation(target, self.samples, settings.train, torch.device(self.device))
        closed_loop = self.closed_loop if settings.train.closed_loop else None
        loop = Loop(imitation_job(run, self.save, closed_loop), settings.train, self.folder, identity)
        target.train()
        return loop.run(on_step)

    def closed_loop(self, target: CompactTarget) -> float:
        """Success in [0, 1] of greedy decoding over the tasks, on seeds of their own."""
        from kerv_cli.rollouts.run import success_of

        seeds = range(VALIDATION_SEED, VALIDATION_SEED + self.settings.train.closed_loop)
        return success_of(target, self.tasks, seeds, self.settings.world)

    def save(self, module: nn.Module, metrics: Metrics) -> None:
        """Write the weights and what made them."""
        assert isinstance(module, CompactTarget)
        made = {
            "command": "kerv train target",
            "settings": asdict(self.settings),
            **self.origin,
            "demos": {"sha256": self.dataset.sha256, "config": self.dataset.manifest.config},
            "validation": metrics,
            "parameters": sum(p.numel() for p in module.parameters()),
            **provenance(self.device),
        }
        save_target(self.folder, module, self.dataset.manifest.environment, made, self.settings.train.half)


class DrafterRun:
    """`kerv train drafter`."""

    noun = "drafter"

    def __init__(self, settings: TrainDrafterSettings) -> None:
        self.settings = settings
        if settings.train.init is not None:
            raise UsageError(f"train.init={settings.train.init}: only 'kerv train target' begins with given weights")
        self.target_folder = find_target(settings.results, settings.policy.target)
        self.folder = self.place()
        self.dataset = DemoDataset.open(artifact(settings.results, "demos", settings.demos))

    def place(self) -> Path:
        """Where the drafter is put."""
        return artifact_folder("drafter")(self.settings.results, self.settings.policy.drafter, self.target_folder)

    def plan(self) -> str:
        """One line: what the run would do."""
        s = self.settings
        return (
            f"{self.folder}: {s.drafter.layers}-layer {self.noun} of {self.target_folder}, greedy decodes of "
            f"{s.drafter.samples} observations, {s.train.steps} steps of {s.train.batch}"
        )

    def load(self, progress: Progress) -> None:
        """Load the target and let it decode the demonstrations' observations."""
        self.device, _ = set_up(self.settings.runtime)
        self.target, self.described = load_target(self.target_folder, self.device)
        check_spaces(self.target, self.dataset)
        self.teach(progress)

    def teach(self, progress: Progress) -> None:
        """The target's decodes, for training and validation."""
        tasks = tuple(dict.fromkeys(e.task for e in self.dataset.episodes))
        samples = load_samples(self.dataset, self.target.settings, self.target.words, tasks)
        training, held_out = split(samples, self.settings.train.held_out)
        limit = self.settings.drafter.samples
        self.states = teach(self.target, training, limit, lambda done, total: progress(done, total))
        self.held_out = teach(self.target, held_out, max(60, limit // 50), lambda done, total: None)

    def job(self) -> Job:
        """What the loop optimises."""
        drafter = Drafter.beside(self.settings.drafter, self.target).to(self.device)
        run = Distillation(drafter, self.target, self.states, self.held_out, self.settings.drafter)
        return distillation_job(run, self.save)

    def train(self, on_step: Callable[[int, Metrics], None]) -> Metrics:
        """Train, resuming what is there -> metrics of the best checkpoint."""
        settings = self.settings
        torch.manual_seed(settings.train.seed)
        job = self.job()
        identity = identity_of(
            drafter=asdict(settings.drafter),
            train=determining(settings.train),
            demos=self.dataset.sha256,
            target=self.described.sha256,
        )
        loop = Loop(job, settings.train, self.folder, identity)
        job.module.train()
        return loop.run(on_step)

    def save(self, module: nn.Module, metrics: Metrics) -> None:
        """Write the weights and what made them."""
        made = {
            "command": "kerv train drafter",
            "settings": asdict(self.settings),
            "demos": {"sha256": self.dataset.sha256, "config": self.dataset.manifest.config},
            "validation": metrics,
            "parameters": sum(p.numel() for p in module.parameters()),
            **provenance(self.device),
        }
        self.write(module, made)

    def write(self, module: nn.Module, made: dict[str, Any]) -> None:
        """Write the weights; made: provenance."""
        assert isinstance(module, Drafter)
        save_drafter(self.folder, module, self.target, self.described.sha256, made, self.settings.train.half)


class EarlyRun(DrafterRun):
    """`kerv train drafter drafter=early`."""

    noun = "early drafter"

    def place(self) -> Path:
        return artifact_folder("early")(self.settings.results, self.settings.policy.early, self.target_folder)

    def teach(self, progress: Progress) -> None:
        taught = teach_early(self.target, self.dataset, self.settings.drafter, progress)
        self.training, self.validation = taught.split(self.settings.train.held_out)

    def job(self) -> Job:
        early = EarlyDrafter.beside(self.settings.drafter, self.target)
        early.standardise(self.training.features)
        run = EarlyDistillation(early.to(self.device), self.training, self.validation, self.settings.train)
        return early_job(run, self.save)

    def write(self, module: nn.Module, made: dict[str, Any]) -> None:
        assert isinstance(module, EarlyDrafter)
        save_early(self.folder, module, self.described.sha256, made, self.settings.train.half)


DRAFTER_RUNS: dict[str, type[DrafterRun]] = {"eagle": DrafterRun, "early": EarlyRun}


def drafter_run(settings: TrainDrafterSettings) -> DrafterRun:
    """The run of `drafter.kind`.

    Raises:
        UnknownName: no such kind.
    """
    if settings.drafter.kind not in DRAFTER_RUNS:
        raise UnknownName("drafter.kind", settings.drafter.kind, DRAFTER_RUNS)
    return DRAFTER_RUNS[settings.drafter.kind](settings)
