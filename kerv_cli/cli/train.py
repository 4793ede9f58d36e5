"""`kerv train target` and `kerv train drafter`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from kerv_cli.base.errors import UsageError
from kerv_cli.base.settings import TrainDrafterSettings, TrainTargetSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, ShowPlan, print_figures, print_json, print_plan, progress_bar

if TYPE_CHECKING:
    from kerv_cli.training.runs import DrafterRun, TargetRun

MOST_POINTS = 1000
"""Of a curve, so that a long run does not wait for its tracker; validations are all logged."""
_MODULES = {"trackio": "trackio", "wandb": "wandb", "tensorboard": "torch.utils.tensorboard"}


@command(
    "train target",
    TrainTargetSettings,
    keys="name demos task target target.observation train.steps train.init world.camera.name log runtime.device",
    examples=(
        "kerv train target name=mine demos=mt10",
        "kerv train target name=quick target=nano train.steps=500 --plan",
    ),
)
def target(settings: TrainTargetSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Behaviour-clone the target on demonstrations."""
    typer.echo(f"target {settings.name}: {settings.train.steps} steps", err=True)
    from kerv_cli.training.runs import TargetRun

    run_training(TargetRun(settings), plan, as_json, "reading demonstrations", "training the target")


@command(
    "train drafter",
    TrainDrafterSettings,
    keys="policy.target drafter demos task policy.drafter policy.early train.steps log runtime.device",
    examples=(
        "kerv train drafter policy.target=mine demos=mt10",
        "kerv train drafter drafter=early policy.target=mine",
    ),
)
def drafter(settings: TrainDrafterSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Train a drafter, or with drafter=early the early one, on the target's own greedy decodes."""
    typer.echo(f"{settings.drafter.kind} drafter of {settings.policy.target}: {settings.train.steps} steps", err=True)
    from kerv_cli.training.runs import drafter_run

    run_training(drafter_run(settings), plan, as_json, "the target's greedy decodes", "training the drafter")


def run_training(run: TargetRun | DrafterRun, plan: bool, as_json: bool, loading: str, training: str) -> None:
    if plan:
        print_plan(run.plan(), as_json)
    from kerv_cli.training.loop import without_subnormals

    with without_subnormals(), progress_bar(loading) as advance:
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
        _live(settings.log, name, run.folder, settings.train.steps, asdict(settings)) as log,
        progress_bar(training) as advance,
    ):
        metrics = run.train(on_step)
    from kerv_cli.report.curves import save_curves

    plot = save_curves(run.folder)
    if as_json:
        print_json({"folder": run.folder, "best": metrics, "curves": plot})
        return
    print_figures("best checkpoint", metrics, run.folder)
    typer.echo(f"curves in {run.folder / 'log.csv'} and {plot}")


def _line(metrics: dict[str, float]) -> str:
    return " ".join(f"{k} {v:.4g}" for k, v in list(metrics.items())[:6] if k != "step")


@contextmanager
def _live(
    tracker: str, name: str, folder: Path, steps: int, config: Mapping[str, object]
) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Yields the function that logs the numbers of a step: of an update, or of a validation, which has a `step` among
    them.

    Args:
        tracker: trackio, wandb, tensorboard; none: nothing is logged.
        folder: of the training; TensorBoard's files go there.
        steps: of the whole run.

    Raises:
        UsageError: the tracker is not installed.
    """
    if tracker == "none":
        yield lambda step, numbers: None
        return
    try:
        module = import_module(_MODULES[tracker])
    except ImportError as error:
        raise UsageError(f"log={tracker}: pip install 'kerv[{tracker}]'") from error
    if tracker == "tensorboard":
        run = module.SummaryWriter(str(folder / "tensorboard"))
    else:
        run = module.init(project="kerv", name=name, config=dict(config))

    def log(step: int, numbers: Mapping[str, float]) -> None:
        validation = "step" in numbers
        if not validation and step % max(1, steps // MOST_POINTS):
            return
        kind = "validation" if validation else "training"
        named = {f"{kind}/{key}": value for key, value in numbers.items() if key != "step"}
        if tracker == "tensorboard":
            for key, value in named.items():
                run.add_scalar(key, value, step)
        else:
            run.log(named, step=step)

    try:
        yield log
    finally:
        (run.close if tracker == "tensorboard" else run.finish)()
