"""`kerv train target` and `kerv train drafter`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.cli import common
from kerv_cli.cli.common import AsJson, Overrides, ShowConfig, ShowPlan, edge, progress_bar

if TYPE_CHECKING:
    from kerv_cli.training.runs import DrafterRun, TargetRun

app = typer.Typer(
    help="Train the target or a drafter.", no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
)


@app.command("target")
@edge
def target(
    overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False, as_json: AsJson = False
) -> None:
    """Behaviour-clone the target on demonstrations."""
    from kerv_cli.base.settings import TrainTargetSettings

    settings = common.composed("train_target", overrides, TrainTargetSettings, cfg)
    from kerv_cli.training.runs import TargetRun

    run_training(TargetRun(settings), plan, as_json, "reading demonstrations", "training the target")


@app.command("drafter")
@edge
def drafter(
    overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False, as_json: AsJson = False
) -> None:
    """Train a drafter, or with drafter=early the early one, on the target's own greedy decodes."""
    from kerv_cli.base.settings import TrainDrafterSettings

    settings = common.composed("train_drafter", overrides, TrainDrafterSettings, cfg)
    from kerv_cli.training.runs import drafter_run

    run_training(drafter_run(settings), plan, as_json, "the target's greedy decodes", "training the drafter")


@app.command("score")
@edge
def score(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Train a score that expects a draft's loss, on what 'kerv calibrate risk features=true' recorded."""
    from kerv_cli.base.settings import TrainScoreSettings

    settings = common.composed("train_score", overrides, TrainScoreSettings, cfg)
    from kerv_cli.training.score_training import ScoreRun

    run = ScoreRun(settings)
    if plan:
        common.print_plan(run.plan())
    with progress_bar("training the score") as advance:
        metrics = run.train(advance)
    common.print_figures("held-out episodes", metrics, run.folder)


def run_training(run: TargetRun | DrafterRun, plan: bool, as_json: bool, loading: str, training: str) -> None:
    if plan:
        common.print_plan(run.plan(), as_json)
    with progress_bar(loading) as advance:
        run.load(advance)
    begun = False

    def on_step(step: int, now: dict[str, float]) -> None:
        nonlocal begun
        if not begun and step > 1 and run.ranks.first:
            typer.echo(f"resuming at step {step - 1}", err=True)
        begun = True
        advance(step, run.settings.train.steps, _line(now))

    with progress_bar(training) as advance:
        metrics = run.train(on_step)
    if not run.ranks.first:
        return
    from kerv_cli.report.curves import save_curves

    plot = save_curves(run.folder)
    if as_json:
        common.print_json({"folder": run.folder, "best": metrics, "curves": plot})
        return
    common.print_figures("best checkpoint", metrics, run.folder)
    typer.echo(f"curves in {run.folder / 'log.csv'} and {plot}")


def _line(metrics: dict[str, float]) -> str:
    return " ".join(f"{k} {v:.4g}" for k, v in list(metrics.items())[:6] if k != "step")
