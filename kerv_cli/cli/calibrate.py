"""`kerv calibrate` and `kerv calibrate success`: fit constants of the methods, and certify their success."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import typer

from kerv_cli.cli.command import Cfg, command
from kerv_cli.cli.common import AsJson, ShowPlan, as_planned, end_with_json, print_rows, print_table, settings_yaml
from kerv_cli.training.settings import CalibrateSettings, CalibrateSuccessSettings

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
    from kerv_cli.training.calibration import calibrate

    with as_planned(settings, plan) as (database, begin):
        path, calibration, notes = calibrate(settings, database, begin)
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
    """Print when a retrieved chunk of each task may be executed without verification (docs/methods.md §4)."""
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


@command(
    "calibrate success",
    CalibrateSuccessSettings,
    keys="study margin delta task episodes policy.target policy.artifacts runtime.workers results",
    each="rollout",
)
def success(overrides: list[str], cfg: Cfg = False, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Run a study's settings on seeds of their own, the most cautious first, and certify which keep AR's success.

    Existing episodes are reused. Choose the number of episodes before you look at any result.

    Examples:
        kerv calibrate success policy.target=mine
        kerv calibrate success policy.artifacts.certificate=mine margin=3 episodes=50 seed=50600 again=true --plan
    """
    from kerv_cli.cli.studies import planned_study, print_settings, print_study_plan, run_study
    from kerv_cli.episodes.resolve import resolve

    resolved = resolve(overrides, "calibrate_success", CalibrateSuccessSettings)
    settings = cast(CalibrateSuccessSettings, resolved.sweep)
    if cfg:
        for line in settings_yaml(settings).splitlines():
            if line.split(":")[0] in ("margin", "delta", "again"):
                typer.echo(line)
        typer.echo("---")
        print_settings(resolved)
        return
    # these import torch, which --cfg and a mistyped key must not wait for
    from kerv_cli.lab.runs import making
    from kerv_cli.report.certificate import candidate_rows, certify, folder_of, planned_certificate, write

    folder = folder_of(resolved)
    planned = planned_study(resolved, ["calibrate", "success", *overrides])
    certificate = planned_certificate(resolved, planned, planned.episodes, settings)
    if plan:
        print_study_plan(planned, as_json)
        return
    with making(planned.database, "certificate", folder):
        if run_study(planned).failed:
            raise typer.Exit(1)
        certificate = certify(certificate, planned, planned.episodes, resolved.study.baseline)
        path = write(folder, certificate)
    rows = candidate_rows(certificate)
    if as_json:
        end_with_json({"certificate": path, "sentence": certificate.sentence(), "candidates": rows})
    title = f"not more than {settings.margin:g} points below AR? tested in this order, each at {certificate.delta:g}"
    print_rows(rows, title)
    typer.echo(f"{certificate.sentence()}\n{path}")
