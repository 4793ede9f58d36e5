"""`kerv sweep`: run a study's settings over tasks and seeds; go on where it was cut."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.commands.common import Overrides, ShowConfig, ShowPlan, called, console, edge

if TYPE_CHECKING:
    from kerv_cli.studies.plan import Cell
    from kerv_cli.studies.resolve import ResolvedStudy
    from kerv_cli.studies.store import StudyStore

SECONDS_PER_EPISODE = 1.0  # before anything was measured; MT10 on one core takes 0.5 to 1.5


@edge
def sweep(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Run a study: every setting on every task with the same seeds. Complete cells are reused."""
    from kerv_cli.config import to_yaml
    from kerv_cli.environments import resolve_tasks, settled, spec_of
    from kerv_cli.studies.resolve import resolve

    resolved = resolve(overrides or [])
    first = next(iter(resolved.settings.values()))
    tasks = resolve_tasks(first.task)
    for settings in resolved.settings.values():
        settings.world = settled(settings.world, spec_of(tasks[0]))
    if cfg:
        typer.echo(to_yaml(resolved.study), nl=False)
        for label, settings in resolved.settings.items():
            typer.echo(f"--- # {label}\n{to_yaml(settings)}", nl=False)
        return
    from kerv_cli.rollouts.policy import check, identity_of
    from kerv_cli.studies.plan import plan as plan_cells
    from kerv_cli.studies.store import StudyStore

    for settings in resolved.settings.values():
        check(settings)
    cells = plan_cells(
        resolved.settings, tasks, identity_of, baseline=resolved.study.baseline, overrides=resolved.overrides
    )
    store = StudyStore(first.results, resolved.study.name)
    if plan:
        _print_plan(cells, store, first.runtime.workers)
        return
    _run(resolved, cells, store, first.runtime.workers)


def _print_plan(cells: list[Cell], store: StudyStore, workers: int) -> None:
    from rich.table import Table

    from kerv_cli.studies.execute import estimate
    from kerv_cli.studies.plan import seeds_text

    table = Table("cell", "setting", "task", "seeds", "", title=f"study {store.name}")
    for cell in cells:
        state = "complete, reused" if store.has_cell(cell.id) else "to run"
        table.add_row(cell.id, cell.label, cell.task, seeds_text(cell.seeds), state)
    console().print(table)
    time = estimate(cells, store, workers, SECONDS_PER_EPISODE)
    typer.echo(f"{time.to_run} cells to run, {time.reused} reused, about {time.seconds / 60:.0f} min ({time.source})")


def _run(resolved: ResolvedStudy, cells: list[Cell], store: StudyStore, workers: int) -> None:
    from kerv_cli.reporting.summary import summary_table
    from kerv_cli.reporting.tables import load_study, study_table
    from kerv_cli.rollouts.cells import CellRunner
    from kerv_cli.studies.execute import execute
    from kerv_cli.studies.progress import ProgressDisplay

    study = resolved.study
    store.write_plan(study, cells)
    with ProgressDisplay(console(stderr=True)) as display:
        outcome = execute(cells, CellRunner(store.rollouts), store, workers, display)
    if outcome.done or outcome.reused:
        console().print(summary_table(study_table(load_study(store, cells))))
    typer.echo(
        f"{len(outcome.done)} cells run, {len(outcome.reused)} reused, {len(outcome.failed)} failed; "
        f"tables and plots: {called()} report study={study.name}"
    )
    recordings = sorted(store.rollouts.glob("*.rrd"))
    if recordings:
        typer.echo(f"{len(recordings)} rollouts in {store.rollouts}; open one with: {called()} view {recordings[0]}")
    for failure in outcome.failed:
        typer.echo(f"kerv: {failure.cell.label} on {failure.cell.task}: {failure.reason}", err=True)
    if outcome.failed:
        raise typer.Exit(1)
