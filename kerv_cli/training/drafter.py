"""`kerv train drafter`: train a drafter to imitate the target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from kerv_cli.base.registry import ProposerPart, find
from kerv_cli.episodes.policy import artifacts_of
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.methods.artifacts import MadeFor
from kerv_cli.methods.drafters import TrainableDrafter
from kerv_cli.training import fit
from kerv_cli.training.demonstrations import check_tasks, demos_for
from kerv_cli.training.settings import Plan, Stage, TrainDrafterSettings
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset

SAMPLES = 64  # decodes of which `--plan` measures the time


def plan_drafter(settings: TrainDrafterSettings, database: Database) -> Plan[tuple[Path, fit.Metrics]]:
    """Check the settings of a training, and return the plan to train a drafter or to go on with its training.

    The target decodes in `runtime.dtype`. The drafter is trained in float32. `Plan.make` returns the drafter's folder
    and the metrics of the best weights.
    """
    drafter: TrainableDrafter = find("drafter", settings.drafter.kind, "drafter.kind").built()
    artifacts, train = artifacts_of(settings), settings.train
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
    identity = fit.identity_of(train, dataset, **imitated)
    begun = bool(command_to_go_on(database, drafter.kind, folder))
    place = fit.Destination(folder, identity, train.steps, f"policy.artifacts.{drafter.kind}", settings.replace, begun)
    layers = f"{shape['layers']}-layer " if "layers" in shape else ""
    samples = f", greedy decodes of {shape['samples']} observations" if "samples" in shape else ""
    text = f"{layers}{drafter.noun} of {artifacts.folder}{samples}, {train.steps} steps of {train.batch}"

    def network_of(target: Any, examples: Any) -> tuple[Any, fit.Loss]:
        torch.manual_seed(train.seed)
        network: Any = drafter.network(settings.drafter, target)
        drafter.prepare(network, examples)
        network.to(target.device)
        draw = fit.batches(len(examples), train)
        return network, lambda step: drafter.loss(network, target, examples.where(draw(step)), step, settings)

    def ready(dataset: DemoDataset, progress: Callable[..., None]) -> fit.Made:
        target = artifacts.target
        examples, rest = drafter.examples(target, dataset, settings.drafter, train.held_out, progress)
        network, loss = network_of(target, examples)
        validate = torch.no_grad()(lambda network: drafter.validate(network, target, rest, settings))
        made_for = MadeFor.of(description)

        def write(folder: Path, network: nn.Module, provenance: dict[str, Any]) -> None:
            drafter.save(folder, network, made_for, provenance, train.stored, settings=shape)

        return network, loss, validate, write

    def seconds() -> float:
        # from a few decodes and steps
        few, target, own = replace(dataset, episodes=dataset.episodes[: fit.FEW]), artifacts.target, settings.drafter
        stride = int(dataset.manifest.config["frame_stride"]) if target.cameras else 1  # control steps per observation
        sample, decodes = own, sum(episode.steps for episode in dataset.episodes) // stride
        if hasattr(own, "samples"):
            sample, decodes = replace(own, samples=min(own.samples, SAMPLES)), min(own.samples, decodes)
        of_decodes, (examples, rest) = fit.timed(
            target.device, lambda: drafter.examples(target, few, sample, train.held_out, lambda *done: None)
        )
        of_steps = fit.seconds_of(network_of(target, examples)[1], train, target.device)
        return of_decodes * decodes / (len(examples) + len(rest)) + of_steps

    def work(stage: Stage) -> tuple[Path, fit.Metrics]:
        return fit.train(settings, dataset, place, "kerv train drafter", "the target's greedy decodes", ready, stage)

    return Plan(drafter.kind, folder, f"{folder}: {text}", work, place.check, seconds)
