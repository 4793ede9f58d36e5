"""`kerv train drafter`: train a drafter to imitate the target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from kerv_cli.base.registry import ProposerPart, find
from kerv_cli.base.runtime import set_up
from kerv_cli.engine.decoder import Stopwatch
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.drafters import TrainableDrafter
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.training import fit
from kerv_cli.training.demonstrations import check_tasks, demos_for
from kerv_cli.training.settings import Plan, TrainDrafterSettings
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset

SAMPLES = 64  # decodes of which `--plan` measures the time


@dataclass(frozen=True)
class DrafterTraining(fit.Training):
    """The training of a drafter, after `plan_drafter` has checked the settings."""

    drafter: TrainableDrafter
    artifacts: Artifacts
    command = "kerv train drafter"
    reading = "the target's greedy decodes"

    def ready(self, dataset: DemoDataset, progress: Callable[..., None]) -> fit.Ready:
        drafter, settings, target = self.drafter, self.settings, self.target()
        held_out, shape = settings.train.held_out, settings.drafter
        examples, rest = drafter.examples(target, dataset, shape, held_out, progress)
        network, loss = self.network(target, examples)
        validate = torch.no_grad()(lambda network: drafter.validate(network, target, rest, settings))
        made_for = MadeFor.of(self.artifacts.description)

        def write(folder: Path, network: nn.Module, provenance: dict[str, Any]) -> None:
            drafter.save(folder, network, made_for, provenance, settings.train.stored, settings=asdict(shape))

        return network, loss, validate, write

    def seconds(self) -> float:
        """Estimate the seconds of all decodes and steps, from a few of each."""
        drafter, dataset, held_out = self.drafter, self.dataset, self.settings.train.held_out
        few, target, own = replace(dataset, episodes=dataset.episodes[: fit.FEW]), self.target(), self.settings.drafter
        stride = int(dataset.manifest.config["frame_stride"]) if target.cameras else 1  # control steps per observation
        sample, decodes = own, sum(episode.steps for episode in dataset.episodes) // stride
        if hasattr(own, "samples"):
            sample, decodes = replace(own, samples=min(own.samples, SAMPLES)), min(own.samples, decodes)
        times = []
        for _ in range(2):  # the first time includes compiling
            clock = Stopwatch(target.device)
            examples, rest = drafter.examples(target, few, sample, held_out, lambda done, total: None)
            times.append(clock.stop())
        of_decodes = min(times) * decodes / (len(examples) + len(rest))
        _, loss = self.network(target, examples)
        return of_decodes + fit.seconds_of(loss, self.settings.train, target.device)

    def target(self) -> Any:
        device, dtype = set_up(self.settings.runtime)
        return load_target(self.artifacts.folder, device, dtype)[0]

    def network(self, target: Any, examples: Any) -> tuple[Any, fit.Loss]:
        train = self.settings.train
        torch.manual_seed(train.seed)
        network: Any = self.drafter.network(self.settings.drafter, target)
        self.drafter.prepare(network, examples)
        network.to(target.device)
        draw = fit.batches(len(examples), train)
        return network, lambda step: self.drafter.loss(network, target, examples.where(draw(step)), step, self.settings)


def plan_drafter(settings: TrainDrafterSettings, database: Database) -> Plan[tuple[Path, fit.Metrics]]:
    """Check the settings of a training, and return the plan to train a drafter or to go on with its training.

    The target decodes in `runtime.dtype`. The drafter is trained in float32. `Plan.make` returns the drafter's folder
    and the metrics of the best weights.
    """
    drafter: TrainableDrafter = find("drafter", settings.drafter.kind, "drafter.kind").built()
    artifacts, train = Artifacts(settings.results, settings.policy), settings.train
    folder, description = artifacts.new(drafter.kind), artifacts.description
    description.check_autoregressive(
        f"policy.target={settings.policy.target}", "there are no greedy decodes to imitate"
    )
    ProposerPart.find(drafter.kind).check_code("drafter", bool(description.actions.code))
    settings, dataset = demos_for(settings, description, database)
    tasks = resolve_tasks(settings.task) if settings.task else ()
    if tasks:
        check_tasks(dataset, tasks)
        dataset = replace(dataset, episodes=[dataset.episodes[index] for index in dataset.of_tasks(*tasks)])
    shape = asdict(settings.drafter)
    imitated = {"drafter": shape, "target": description.sha256, "task": list(tasks)}
    if settings.runtime.dtype != "float32":  # left out, so that trainings from before it counted can be resumed
        imitated["dtype"] = settings.runtime.dtype
    identity, begun = (
        fit.identity_of(train, dataset, **imitated),
        bool(command_to_go_on(database, drafter.kind, folder)),
    )
    place = fit.Destination(folder, identity, train.steps, f"policy.artifacts.{drafter.kind}", settings.replace, begun)
    layers = f"{shape['layers']}-layer " if "layers" in shape else ""
    samples = f", greedy decodes of {shape['samples']} observations" if "samples" in shape else ""
    text = f"{layers}{drafter.noun} of {artifacts.folder}{samples}, {train.steps} steps of {train.batch}"
    return DrafterTraining(settings, dataset, place, drafter, artifacts).plan(drafter.kind, text)
