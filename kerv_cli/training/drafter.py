"""`kerv train drafter`: train a drafter to imitate the target. `kerv build drafter`: import a published drafter."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kerv_cli.base.paths import check_free
from kerv_cli.base.registry import ProposerPart, find
from kerv_cli.base.runtime import set_up
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.drafters import TrainableDrafter
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.public import Convention, read_public
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import check_tasks, demos_for
from kerv_cli.training.fit import Metrics, batches, figures_of, fit, identity_of, resumes, without_subnormals
from kerv_cli.training.settings import BuildDrafterSettings, Plan, Stage, TrainDrafterSettings
from kerv_cli.worlds import resolve_tasks


def plan_drafter(settings: TrainDrafterSettings, database: Database) -> Plan[tuple[Path, Metrics]]:
    """Check the training of a drafter. Its work returns the drafter's folder and the metrics of the best weights.

    The target decodes in `runtime.dtype`. The drafter is trained in float32. An interrupted training goes on.
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
    identity = identity_of(train, dataset, **imitated)

    begun = bool(command_to_go_on(database, drafter.kind, folder))

    def check() -> bool:
        return resumes(folder, identity, f"policy.artifacts.{drafter.kind}", settings.replace, begun)

    check()
    layers = f"{shape['layers']}-layer " if "layers" in shape else ""
    samples = f", greedy decodes of {shape['samples']} observations" if "samples" in shape else ""
    plan = f"{layers}{drafter.noun} of {artifacts.folder}{samples}, {train.steps} steps of {train.batch}"

    def work(stage: Stage) -> tuple[Path, Metrics]:
        device, dtype = set_up(settings.runtime)
        provenance = provenance_of("kerv train drafter", settings, device)
        with without_subnormals():
            with stage("the target's greedy decodes") as progress:
                target: Any = load_target(artifacts.folder, device, dtype)[0]
                examples, held_out = drafter.examples(target, dataset, settings.drafter, train.held_out, progress)
            torch.manual_seed(train.seed)
            network: Any = drafter.network(settings.drafter, target)
            drafter.prepare(network, examples)
            network.to(target.device)
            draw = batches(len(examples), train)

            def loss(step: int) -> tuple[Tensor, Metrics]:
                return drafter.loss(network, target, examples.where(draw(step)), step, settings)

            @torch.no_grad()
            def validate(network: Any) -> Metrics:
                return drafter.validate(network, target, held_out, settings)

            def save(network: Any, metrics: Metrics) -> None:
                made = provenance | figures_of(dataset, network, metrics)
                drafter.save(folder, network, MadeFor.of(description), made, train.stored, settings=shape)

            with stage("training the drafter") as progress:
                return folder, fit(network, loss, validate, save, train, folder, identity, progress)

    return Plan(drafter.kind, folder, f"{folder}: {plan}", work, check, train.steps)


def plan_import(settings: BuildDrafterSettings) -> Plan[tuple[Path, dict[str, Any]]]:
    """Check that a published drafter fits a target. The work copies it, and returns its folder and facts to print."""
    convention = Convention(settings.positions, settings.mask)
    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, settings.policy, device=device, dtype=settings.runtime.dtype)
    folder = artifacts.new(EagleDrafter.kind)

    def check() -> bool:
        check_free(folder, "policy.artifacts.drafter", settings.replace)
        return False

    check()
    network = read_public(Path(settings.checkpoint).expanduser(), artifacts.target, convention)
    layers = network.shape.language.num_hidden_layers
    figures = {"parameters": sum(tensor.numel() for tensor in network.parameters())}
    provenance = provenance_of("kerv build drafter", settings, device, **figures)
    shapes = asdict(DrafterSettings(kind="public", layers=layers))
    made_for = MadeFor.of(artifacts.description)

    def work(stage: Stage) -> tuple[Path, dict[str, Any]]:
        EagleDrafter().save(folder, network, made_for, provenance, settings=shapes, public=asdict(network.shape))
        return folder, {**figures, "layers": layers, **asdict(convention)}

    return Plan(EagleDrafter.kind, folder, str(folder), work, check)
