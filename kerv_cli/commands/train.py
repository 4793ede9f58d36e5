"""`kerv train target` and `kerv train drafter`."""

from __future__ import annotations

import typer

from kerv_cli.commands.common import Overrides, ShowConfig, ShowPlan, console, edge, progress_bar

app = typer.Typer(
    help="Train the target or a drafter.", no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
)


@app.command("target")
@edge
def target(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Behaviour-clone the target on demonstrations."""
    from kerv_cli.config import compose, to_yaml
    from kerv_cli.settings import TrainTargetSettings

    settings = compose("train_target", overrides or [], TrainTargetSettings)
    if cfg:
        typer.echo(to_yaml(settings), nl=False)
        return
    from kerv_cli.training.runs import TargetRun

    run = TargetRun(settings)
    if plan:
        typer.echo(run.plan())
        return
    with progress_bar("reading demonstrations", 1000) as advance:
        run.load(lambda done, total: advance(1000 * done // total, ""))
    with progress_bar("training the target", settings.train.steps) as advance:
        metrics = run.train(lambda step, m: advance(step, _line(m)))
    _summary(metrics, run.folder)


@app.command("drafter")
@edge
def drafter(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Train a drafter, or with drafter=early the early one, on the target's own greedy decodes."""
    from kerv_cli.config import compose, to_yaml
    from kerv_cli.settings import TrainDrafterSettings

    settings = compose("train_drafter", overrides or [], TrainDrafterSettings)
    if cfg:
        typer.echo(to_yaml(settings), nl=False)
        return
    from kerv_cli.training.runs import drafter_run

    run = drafter_run(settings)
    if plan:
        typer.echo(run.plan())
        return
    with progress_bar("the target's greedy decodes", 1000) as advance:
        run.load(lambda done, total: advance(1000 * done // total, ""))
    with progress_bar("training the drafter", settings.train.steps) as advance:
        metrics = run.train(lambda step, m: advance(step, _line(m)))
    _summary(metrics, run.folder)


def _line(metrics: dict[str, float]) -> str:
    return " ".join(f"{k} {v:.4g}" for k, v in list(metrics.items())[:6] if k != "step")


def _summary(metrics: dict[str, float], folder: object) -> None:
    from rich.table import Table

    table = Table("best checkpoint", str(folder))
    for name, value in metrics.items():
        table.add_row(name, f"{value:.4g}")
    console().print(table)
