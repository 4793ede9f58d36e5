"""`kerv calibrate`: fit constants of the methods."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.cli.command import command
from kerv_cli.cli.common import ShowPlan, database_of, made, print_table
from kerv_cli.training.settings import CalibrateSettings

if TYPE_CHECKING:
    from kerv_cli.methods.calibration import SkipSection


@command(
    "calibrate",
    CalibrateSettings,
    keys="policy.target demos task policy.artifacts episodes decodes window boundary_windows epsilon",
)
def constants(settings: CalibrateSettings, plan: ShowPlan = False) -> None:
    """Fit the constants of KERV and HeiSD: predictors, variability per task, boundary ranges and skip levels.

    Examples:
        kerv calibrate demos=mt10 policy.artifacts.calibration=mine
        kerv calibrate policy.target=mine demos=mine decodes=20 --plan
    """
    from kerv_cli.training.calibration import plan_calibration

    database = database_of(settings)
    with made(plan_calibration(settings, database), database, plan) as (path, calibration, notes):
        pass
    rows: list[tuple[object, ...]] = []
    for name, counts in calibration.demos.tasks.items():
        row = calibration.variability.get(name)
        levels = [row.decodes, f"{row.k_s:.3f}"] if row else ["-"] * 2
        rows.append((name, counts["training"], *levels))
    print_table(("task", "fitted on", "decodes", "K_S"), rows, f"calibration in {path}")
    if calibration.skip is not None:
        _print_skip(calibration.skip)
    for line in notes:
        typer.echo(line)


def _print_skip(skip: SkipSection) -> None:
    rows: list[tuple[object, ...]] = []
    for name, task in skip.tasks.items():
        levels, figures = ("never", "-", "-"), ("-", "-")
        if task.share:
            levels = f"{task.s_min:.4f}", f"{task.low:.4f}", f"{task.high:.4f}"
            figures = f"{task.within:.1%}", f"{task.error:.4f}"
        rows.append((name, *levels, f"{task.share:.1%}", *figures, task.entries))
    limit = f"error ≤ {skip.epsilon:g}"
    columns = ("task", "s_min", "low", "high", "would be skipped", limit, "mean error", "entries")
    best = f"best neighbour in another episode, {skip.confidence:.0%} with an error of at most {skip.epsilon:g}"
    print_table(columns, rows, f"verify-skip, {best}")
