"""`kerv train target` and `kerv train drafter`."""

from __future__ import annotations

import typer

from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, ShowPlan
from kerv_cli.cli.studies import run_training
from kerv_cli.training.settings import TrainDrafterSettings, TrainTargetSettings


@command(
    "train target",
    TrainTargetSettings,
    keys="name demos task quick target target.observation train.steps train.init runtime.device",
    examples=(
        "kerv train target name=mine demos=mt10",
        "kerv train target name=first task=reach quick=true --plan",
    ),
)
def target(settings: TrainTargetSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Train a target policy on demonstrations by behaviour cloning."""
    typer.echo(f"target {settings.name}: {settings.train.steps} steps", err=True)
    from kerv_cli.training.target import TargetRun

    run = TargetRun(settings)
    for line in run.notes:
        typer.echo(line, err=True)
    run_training(run, plan, as_json, "reading demonstrations", "training the target")


@command(
    "train drafter",
    TrainDrafterSettings,
    keys="policy.target drafter demos task policy.artifacts train.steps runtime.device",
    examples=(
        "kerv train drafter policy.target=mine demos=mt10",
        "kerv train drafter drafter=early policy.target=mine",
    ),
)
def drafter(settings: TrainDrafterSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Train a drafter to imitate a target's greedy decodes. drafter=NAME chooses its kind, such as early."""
    typer.echo(f"drafter={settings.drafter.kind} of {settings.policy.target}: {settings.train.steps} steps", err=True)
    from kerv_cli.training.drafter import DrafterRun

    run_training(DrafterRun(settings), plan, as_json, "the target's greedy decodes", "training the drafter")
