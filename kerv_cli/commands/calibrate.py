"""`kerv calibrate`: what predictors, thresholds, the boundary and verify-skip need, from the demonstrations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.commands.common import Overrides, ShowConfig, ShowPlan, composed, console, edge, print_plan, progress_bar

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from kerv_cli.decoding.calibration_file import Calibration


@edge
def calibrate(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Fit the kinematic predictors, each task's variability, the boundary's ranges and the skip levels."""
    from kerv_cli.settings import CalibrateSettings

    settings = composed("calibrate", overrides, CalibrateSettings, cfg)
    from kerv_cli.training.calibration import CalibrationRun

    run = CalibrationRun(settings)
    if plan:
        print_plan(run.plan())
    with progress_bar("reading demonstrations", len(run.chosen)) as advance:
        run.load(lambda done, total: advance(done, ""))
    variability, skip = {}, None
    if settings.decodes:
        with progress_bar("pre-sampling", len(run.tasks)) as advance:
            variability = run.presample(lambda done, total: advance(done, ""))
    with progress_bar("boundary ranges", len(run.paths) * len(settings.boundary_windows)) as advance:
        boundary = run.boundary(lambda done, total: advance(done, ""))
    if run.stored:
        with progress_bar("skip levels", len(run.tasks)) as advance:
            skip = run.skip(lambda done, total: advance(done, ""))
    with console(stderr=True).status("fitting the predictors"):
        calibration = run.finish(variability, boundary, skip)
    _tasks(calibration, run.path)
    _noise(calibration)
    _errors(calibration)
    _boundary(calibration)
    _skip(calibration)
    for line in run.notes:
        typer.echo(line)


def _tasks(calibration: Calibration, path: Path) -> None:
    from rich.table import Table

    columns = ("task", "fitted on", "tested on", "decodes", "K_S", "K p25", "K p75", "Kalman, h=1", "hold, h=1")
    table = Table(*columns, title=f"calibration in {path}")
    kalman, hold = (_moving_errors(calibration, kind)[:, 0] for kind in ("kalman", "hold"))
    for number, (name, counts) in enumerate(calibration.demos.tasks.items()):
        row = calibration.variability.get(name)
        levels = [str(row.decodes), *(f"{x:.3f}" for x in (row.k_s, row.p25, row.p75))] if row else ["-"] * 4
        episodes = [str(counts["training"]), str(counts["held_out"])]
        table.add_row(name, *episodes, *levels, f"{kalman[number]:.4f}", f"{hold[number]:.4f}")
    console().print(table)


def _noise(calibration: Calibration) -> None:
    from rich.table import Table

    space = calibration.target.actions
    moving = [dof for dof in range(space.dofs) if not space.is_strict[dof]]
    table = Table("filter", *(space.names[dof] for dof in moving), title="fitted q / r (damping)")
    for kind, noise in calibration.noise.items():
        cells = [f"{noise.q[dof] / noise.r[dof]:.3g} ({noise.damping[dof]:.2g})" for dof in moving]
        table.add_row(kind, *cells)
    console().print(table)


def _moving_errors(calibration: Calibration, kind: str) -> np.ndarray:
    from kerv_cli.training.predictor_fit import moving_errors

    return moving_errors(calibration.errors, kind, calibration.target.actions)


def _errors(calibration: Calibration) -> None:
    from rich.table import Table

    hold = _moving_errors(calibration, "hold")
    horizon = hold.shape[1]
    table = Table(
        "predictor",
        *(f"h={h}" for h in range(1, horizon + 1)),
        "below hold at h=1",
        f"at h={horizon}",
        title="held-out error of the moving DoFs, mean of tasks, normalised action units",
    )
    for kind in calibration.errors:
        error = _moving_errors(calibration, kind)
        below = [int((error[:, h] < hold[:, h]).sum()) for h in (0, horizon - 1)]
        wins = ["-" if kind == "hold" else f"{count}/{len(hold)} tasks" for count in below]
        table.add_row(kind, *(f"{e:.4f}" for e in error.mean(0)), *wins)
    console().print(table)


def _boundary(calibration: Calibration) -> None:
    from rich.table import Table

    if calibration.boundary is None:
        return
    columns = ("positions", "radius R, minimum", "95th percentile", "length D, minimum", "95th percentile")
    table = Table(*columns, title="ranges of the boundary's metric, mm")
    for window, r in calibration.boundary.windows.items():
        bounds = (r.radius_low, r.radius_high, r.length_low, r.length_high)
        table.add_row(window, *(f"{1000 * metres:.1f}" for metres in bounds))
    console().print(table)


def _skip(calibration: Calibration) -> None:
    from rich.table import Table

    if calibration.skip is None:
        return
    epsilon, confidence = calibration.skip.epsilon, calibration.skip.confidence
    table = Table(
        *("task", "s_min", "low", "high", "would be skipped", f"error ≤ {epsilon:g}", "mean error", "entries"),
        title=f"verify-skip, best neighbour in another episode, {confidence:.0%} with an error of at most {epsilon:g}",
    )
    for name, row in calibration.skip.tasks.items():
        levels = [f"{x:.4f}" for x in (row.s_min, row.low, row.high)] if row.share else ["never", "-", "-"]
        figures = [f"{row.within:.1%}", f"{row.error:.4f}"] if row.share else ["-", "-"]
        table.add_row(name, *levels, f"{row.share:.1%}", *figures, str(row.entries))
    console().print(table)
