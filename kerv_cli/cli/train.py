"""`kerv train target` and `kerv train drafter`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer

from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, ShowPlan, database_of, end_with_json, made, print_figures
from kerv_cli.training.settings import TrainDrafterSettings, TrainTargetSettings


@command(
    "train target",
    TrainTargetSettings,
    keys="name demos task quick target target.observation train.steps train.init replace runtime.device",
)
def target(settings: TrainTargetSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Train a target policy on demonstrations by behaviour cloning.

    Examples:
        kerv train target name=mine demos=mt10
        kerv train target name=first task=reach quick=true --plan
    """
    typer.echo(f"target {settings.name}: {settings.train.steps} steps", err=True)
    from kerv_cli.training.target import plan_target

    _train(plan_target, settings, plan, as_json)


@command(
    "train drafter",
    TrainDrafterSettings,
    keys="policy.target drafter demos task policy.artifacts train.steps replace runtime.device",
)
def drafter(settings: TrainDrafterSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Train a drafter to imitate a target's greedy decodes. drafter=NAME chooses its kind, such as early.

    Examples:
        kerv train drafter policy.target=mine demos=mt10
        kerv train drafter drafter=early policy.target=mine
    """
    typer.echo(f"drafter={settings.drafter.kind} of {settings.policy.target}: {settings.train.steps} steps", err=True)
    from kerv_cli.training.drafter import plan_drafter

    _train(plan_drafter, settings, plan, as_json)


def _train(planned: Callable[..., Any], settings: Any, plan: bool, as_json: bool) -> None:
    from kerv_cli.report.plots import save_curves

    database = database_of(settings)
    with made(planned(settings, database), database, plan, as_json) as (folder, metrics):
        curves = save_curves(folder)
    if as_json:
        end_with_json({"folder": folder, "best": metrics, "curves": curves})
    print_figures("best checkpoint", metrics, folder)
    typer.echo(f"curves in {folder / 'log.csv'} and {curves}")
