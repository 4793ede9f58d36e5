"""`kerv sweep`: run a study's settings over tasks and seeds; an interrupted sweep resumes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.commands.common import Overrides, ShowConfig, ShowPlan, called, console, edge, print_notes, print_table

if TYPE_CHECKING:
    from kerv_cli.settings import RuntimeSettings
    from kerv_cli.studies.plan import Cell
    from kerv_cli.studies.resolve import ResolvedStudy
    from kerv_cli.studies.store import StudyStore

SECONDS_PER_EPISODE = 1.0  # before anything was measured; MT10 on one core takes 0.5 to 1.5


@edge
def sweep(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Run a study: every setting on every task with the same seeds, in turn. Complete cells are reused."""
    from kerv_cli.config import to_yaml
    from kerv_cli.environments import resolve_tasks
    from kerv_cli.studies.executors import check_executor
    from kerv_cli.studies.resolve import idle_overrides, resolve

    resolved = resolve(overrides or [])
    first = next(iter(resolved.settings.values()))
    tasks = resolve_tasks(first.task)
    if cfg:
        typer.echo(to_yaml(resolved.study), nl=False)
        for label, settings in resolved.settings.items():
            typer.echo(f"--- # {label}\n{to_yaml(settings)}", nl=False)
        return
    print_notes(idle_overrides(resolved))
    check_executor(first.runtime)
    from kerv_cli.rollouts.policy import check, identity_of
    from kerv_cli.studies.plan import plan as plan_cells
    from kerv_cli.studies.store import StudyStore

    study = resolved.study
    for settings in resolved.settings.values():
        check(settings)
    cells = plan_cells(
        resolved.settings,
        tasks,
        identity_of,
        baseline=study.baseline,
        overrides=resolved.overrides,
        block=study.block,
        repeats=study.repeats,
    )
    store = StudyStore(first.results, study.name)
    if plan:
        _print_plan(cells, store, first.runtime.workers)
        return
    _run(resolved, cells, store, first.runtime)


def _print_plan(cells: list[Cell], store: StudyStore, workers: int) -> None:
    from kerv_cli.studies.estimate import estimate
    from kerv_cli.studies.plan import seeds_text

    by_label: dict[str, list[Cell]] = {}
    for cell in cells:
        by_label.setdefault(cell.label, []).append(cell)
    rows = []
    for label, own in by_label.items():
        reused = sum(store.has_cell(cell.id) for cell in own)
        seeds = seeds_text(seed for cell in own for seed in cell.seeds)
        tasks, repeats = len({cell.task for cell in own}), len({cell.repeat for cell in own})
        rows.append((label, len(own) - reused, reused, tasks, seeds, repeats))
    print_table(("setting", "to run", "reused", "tasks", "seeds", "repeats"), rows, f"study {store.name}")
    time = estimate(cells, store, workers, SECONDS_PER_EPISODE)
    typer.echo(f"{time.to_run} cells to run, {time.reused} reused, about {time.seconds / 60:.0f} min ({time.source})")


def _run(resolved: ResolvedStudy, cells: list[Cell], store: StudyStore, runtime: RuntimeSettings) -> None:
    from kerv_cli.reporting.summary import summary_table
    from kerv_cli.reporting.tables import load_study, study_table
    from kerv_cli.rollouts.cells import CellRunner, reference_decode
    from kerv_cli.studies.execute import execute
    from kerv_cli.studies.progress import ProgressDisplay

    store.write_plan(resolved.study, cells)
    with ProgressDisplay(console(stderr=True)) as display:
        outcome = execute(cells, CellRunner(store.rollouts), store, runtime, display, reference_decode)
    if outcome.done or outcome.reused:
        console().print(summary_table(study_table(load_study(store, cells))))
    episodes = sum(len(cell.seeds) for cell in outcome.done)
    if episodes:
        minutes = outcome.seconds / 60
        typer.echo(f"{episodes} episodes in {minutes:.1f} min: {episodes / minutes:.0f} per minute")
    typer.echo(
        f"{len(outcome.done)} cells run, {len(outcome.reused)} reused, {len(outcome.failed)} failed; "
        f"tables and plots: {called()} report study={store.name}"
    )
    recordings = sorted(store.rollouts.glob("*.rrd"))
    if recordings:
        typer.echo(f"{len(recordings)} rollouts in {store.rollouts}; open one with: {called()} view {recordings[0]}")
    for failure in outcome.failed:
        typer.echo(f"kerv: {failure.cell.label} on {failure.cell.task}: {failure.reason}", err=True)
    if outcome.failed:
        raise typer.Exit(1)
