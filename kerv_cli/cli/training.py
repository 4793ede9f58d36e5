"""Run a training for a command, with progress, an experiment tracker and plots of its curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import typer

from kerv_cli.cli.common import print_figures, print_json, print_plan, progress_bar

if TYPE_CHECKING:
    from kerv_cli.lab.runs import Run
    from kerv_cli.training.run import TrainingRun


def run_training(
    run: TrainingRun, plan: bool, as_json: bool, loading: str, training: str, command: Sequence[str] = ()
) -> None:
    """Run a training and show its progress, or print the plan.

    Args:
        run: The training.
        plan: Print what would be trained, and end the command.
        as_json: Print the result as JSON.
        loading: Title of the progress bar while data are read.
        training: Title of the progress bar during training.
        command: Command-line arguments after `kerv` that resume this training. Empty: those that were typed.

    Raises:
        UsageError: Another process is training the same artifact.
    """
    if plan:
        print_plan(run.plan(), as_json)
    from kerv_cli.lab.runs import making

    with making(run.settings.results, run.artifact_kind, run.folder, command) as record:
        _train(run, record, as_json, loading, training)


def _train(run: TrainingRun, record: Run, as_json: bool, loading: str, training: str) -> None:
    from kerv_cli.training.loop import without_subnormals
    from kerv_cli.training.trackers import tracked

    with without_subnormals(), progress_bar(loading, record) as advance:
        run.load(advance)
    started = False
    settings = run.settings

    def on_step(step: int, now: dict[str, float]) -> None:
        nonlocal started
        if not started and step > 1:
            typer.echo(f"resuming at step {step - 1}", err=True)
        started = True
        log(step, now)
        advance(step, settings.train.steps, _line(now))

    name = f"{run.kind}/{run.folder.name}"
    with (
        without_subnormals(),
        tracked(settings.log, name, run.folder, settings.train.steps, asdict(settings)) as log,
        progress_bar(training, record) as advance,
    ):
        metrics = run.train(on_step)
    from kerv_cli.report.plots import save_curves

    plot = save_curves(run.folder)
    if as_json:
        print_json({"folder": run.folder, "best": metrics, "curves": plot})
        return
    print_figures("best checkpoint", metrics, run.folder)
    typer.echo(f"curves in {run.folder / 'log.csv'} and {plot}")


def _line(metrics: dict[str, float]) -> str:
    return " ".join(f"{k} {v:.4g}" for k, v in list(metrics.items())[:6] if k != "step")
