"""`kerv calibrate`: fit constants of the methods."""

from __future__ import annotations

import typer

from kerv_cli.cli.command import command
from kerv_cli.cli.common import ShowPlan, database_of, made, print_table
from kerv_cli.training.settings import CalibrateSettings


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
    levels_of = calibration.skip.tasks if calibration.skip else {}
    columns = ("task", "fitted on", "decodes", "K_S", *(("s_min", "would be skipped") if levels_of else ()))
    rows: list[tuple[object, ...]] = []
    for name, counts in calibration.demos.tasks.items():
        row, skip = calibration.variability.get(name), levels_of.get(name)
        levels = [row.decodes, f"{row.k_s:.3f}"] if row else [None] * 2
        skips = [f"{skip.s_min:.4f}" if skip.share else "never", f"{skip.share:.1%}"] if skip else []
        rows.append((name, counts["training"], *levels, *skips))
    print_table(columns, rows, f"calibration in {path}")
    for line in notes:
        typer.echo(line)
