"""`kerv sweep`: run a study's settings over tasks and seeds; an interrupted sweep resumes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.base.config import Composer, conf_dir, expand, groups, split_words, to_yaml
from kerv_cli.base.durations import about
from kerv_cli.base.errors import UsageError
from kerv_cli.base.settings import RolloutSettings, SweepSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import (
    AsJson,
    ShowPlan,
    at_work,
    console,
    print_json,
    print_notes,
    print_table,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pandas import DataFrame

    from kerv_cli.lab.events import Outcome
    from kerv_cli.lab.plan import Cell
    from kerv_cli.lab.resolve import ResolvedStudy
    from kerv_cli.lab.reuse import Covered
    from kerv_cli.lab.store import StudyStore

SECONDS_PER_EPISODE = 1.0  # before anything was measured; MT10 on one core takes 0.5 to 1.5


@command(
    "sweep",
    SweepSettings,
    keys="study task episodes policy until rerun loss runtime.workers results",
    examples=("kerv sweep study=demo", "kerv sweep study=threshold task=[reach,push] episodes=5 --plan"),
    each="rollout",
)
def sweep(words: list[str], cfg: bool = False, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Run a study: every setting on every task with the same seeds, in turn. Complete cells are reused. Without study=
    list the studies."""
    if not cfg and not any(word.split("=")[0].split(".")[0] == "study" for word in words):
        others = [word for word in words if not word.startswith("results=")]
        if others:
            raise UsageError(f"{' '.join(others)} of which study? name one, study=NAME: 'kerv sweep' lists them; "
                             "'kerv rollout -m' runs a grid of your own")  # fmt: skip
        _list_studies(as_json)
        return
    from kerv_cli.lab.resolve import resolve

    resolved = resolve(words)
    if cfg:
        print_settings(resolved)
        return
    covered = covered_cells(resolved, words)
    if plan:
        print_sweep_plan(covered, resolved.first.runtime.workers, as_json)
        return
    outcome = run_covered(resolved, covered, words)
    _print_outcome(outcome, resolved, covered, words, as_json)
    if outcome.failed:
        raise typer.Exit(1)


def print_settings(resolved: ResolvedStudy) -> None:
    """Prints the study and each of its settings as YAML, for --cfg."""
    typer.echo(to_yaml(resolved.study), nl=False)
    for label, settings in resolved.settings.items():
        typer.echo(f"--- # {label}\n{to_yaml(settings)}", nl=False)


def covered_cells(resolved: ResolvedStudy, words: list[str]) -> Covered:
    """The study's cells: those on disk and those to run. Everything that can be refused before an episode runs is
    refused here. Prints which overrides have no effect and which cells disagree. words: of the command."""
    from kerv_cli.cli.rollout import planned_cells
    from kerv_cli.lab.resolve import idle_overrides
    from kerv_cli.lab.reuse import Stock, cover, disagreements
    from kerv_cli.lab.store import StudyStore

    print_notes(idle_overrides(resolved))
    cells = planned_cells(resolved)
    store = StudyStore(resolved.first.results, resolved.study.name)
    stock = Stock(store)
    covered = cover(cells, stock, resolved.sweep.rerun, store.interrupted_since(["sweep", *words]))
    _warn(disagreements(covered.complete, stock))
    return covered


def _list_studies(as_json: bool) -> None:
    """Prints the studies of conf/ and how large each is."""
    from kerv_cli.lab.resolve import study_of_file, tasks_of

    rows, composer = [], Composer("rollout", RolloutSettings)
    for name in groups()["study"]:
        study = study_of_file(conf_dir() / "study" / f"{name}.yaml")
        common = composer.compose(split_words(study.common))
        settings, tasks = sum(len(expand(text)) for text in study.settings.values()), len(tasks_of(common))
        rows.append((name, settings, tasks, common.episodes, settings * tasks * common.episodes, study.title))
    columns = ("study", "settings", "tasks", "episodes", "in all", "")
    if as_json:
        print_json([dict(zip((*columns[:5], "title"), row, strict=True)) for row in rows])
        return
    print_table(columns, rows, "episodes: per task; in all: settings x tasks x episodes")
    typer.echo("run one, e.g.: kerv sweep study=demo; what it would do: --plan")


def _warn(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(f"kerv: warning: {line}", err=True)


def print_sweep_plan(covered: Covered, workers: int, as_json: bool) -> None:
    """Prints which cells would be run, why, and how long that takes."""
    from kerv_cli.lab.plan import seeds_text
    from kerv_cli.lab.reuse import estimate

    by_label: dict[str, list[Cell]] = {}
    for cell in covered.cells:
        by_label.setdefault(cell.label, []).append(cell)
    columns = ("setting", "to run", "reused", "tasks", "seeds", "repeats", "why")
    rows = []
    for label, cells in by_label.items():
        to_run = [cell for cell in cells if cell.id in covered.reasons]
        seeds = seeds_text(seed for cell in cells for seed in cell.seeds)
        tasks, repeats = len({cell.task for cell in cells}), len({cell.repeat for cell in cells})
        why = "; ".join(dict.fromkeys(covered.reasons[cell.id] for cell in to_run))
        rows.append((label, len(to_run), len(cells) - len(to_run), tasks, seeds, repeats, why))
    store, time = covered.store, estimate(covered, workers, SECONDS_PER_EPISODE)
    if as_json:
        settings = [dict(zip(columns, row, strict=True)) for row in rows]
        print_json({"study": store.name, "folder": store.root, "settings": settings, "to run": time.to_run,
                    "reused": time.reused, "seconds": time.seconds, "source": time.source})  # fmt: skip
        return
    print_table(columns, rows, f"study {store.name}")
    typer.echo(f"{time.to_run} cells to run, {time.reused} reused, {about(time.seconds, time.source)}")


def run_covered(resolved: ResolvedStudy, covered: Covered, words: list[str]) -> Outcome:
    """Runs the cells that are not complete; warns of results that differ from earlier ones.

    Raises:
        Interrupted: Ctrl-C.
    """
    from kerv_cli.cli.running import running
    from kerv_cli.lab.reuse import NEVER, Stock, disagreements, take_over

    store, cells = covered.store, covered.cells
    take_over(covered)
    if resolved.sweep.until == "done":
        store.write_plan(resolved.study, cells)
    store.note_command(["sweep", *words])
    with running(store, cells, resolved.first.runtime) as run:
        outcome = _run_until_decided(resolved, cells, store, run) if resolved.sweep.until == "decided" else run(cells)
    if not outcome.failed:
        store.note_finished()
    if resolved.sweep.rerun != NEVER:
        _warn(disagreements(outcome.done, Stock(store, others=False)))
    return outcome


def _run_until_decided(
    resolved: ResolvedStudy, cells: list[Cell], store: StudyStore, run: Callable[[list[Cell]], Outcome]
) -> Outcome:
    """Runs block after block of seeds and leaves out the settings that are decided. The plan holds the cells that
    ran."""
    from kerv_cli.lab.events import Outcome
    from kerv_cli.report import decide
    from kerv_cli.report.tables import load_study

    study, margin = resolved.study, resolved.sweep.loss / 100
    blocks = decide.looks_of(cells, study.block)
    typer.echo(decide.stopping_rule(resolved.sweep.loss, len(blocks)), err=True)
    latest: dict[str, decide.Verdict] = {}
    planned: list[Cell] = []
    total = Outcome()
    open_labels = [label for label in resolved.settings if label != study.baseline]
    for look, block in enumerate(blocks, 1):
        to_run = [cell for cell in block if cell.label in (study.baseline, *open_labels)]
        planned += to_run
        store.write_plan(study, planned)
        outcome = run(to_run)
        lists = total.done + outcome.done, total.reused + outcome.reused, total.failed + outcome.failed
        total = Outcome(*lists, total.seconds + outcome.seconds)
        if outcome.failed:
            return total
        verdicts = decide.verdicts(load_study(store, planned), open_labels, margin, look, len(blocks))
        typer.echo(f"look {look} of {len(blocks)}: {decide.progress_line(verdicts)}", err=True)
        latest |= {verdict.label: verdict for verdict in verdicts}
        decide.write_verdicts(store.root, latest, resolved.sweep.loss, len(blocks))
        open_labels = [verdict.label for verdict in verdicts if verdict.verdict == decide.OPEN]
        if not open_labels:
            break
    return total


def print_study(table: DataFrame, store: StudyStore, words: list[str]) -> None:
    """Prints a study's table, its note, and the command that measures the times which it lacks. words: of the present
    command."""
    from kerv_cli.report.summary import SummaryTable, not_in_turn
    from kerv_cli.report.tables import values_of

    console().print(SummaryTable(table))
    codes, commits = values_of(table, "code"), values_of(table, "git_commit")
    if len(codes) > 1:
        names = ", ".join(sorted(commit[:12] for commit in commits))
        typer.echo(f"its cells are of {len(codes)} states of the code, commits {names}")
    apart = not_in_turn(table)
    if apart:
        mend = "" if store.is_imported else f"; '{store.sweep_command('rerun=timed')}' does that"
        typer.echo(f"no speedup of {', '.join(apart)}: not measured in turn with the baseline{mend}")
    note = store.read_plan().note
    if note:
        typer.echo(f"\n{note}\n")


def print_verdict(table: DataFrame, store: StudyStore, loss: float) -> None:
    """Prints the last three lines of a study: the verdict, the page to open, the recording to watch."""
    from kerv_cli.report.page import verdict

    typer.echo(f"verdict: {verdict(table, loss)[0]}")
    typer.echo(f"page: {store.root / 'report.html'}")
    recordings = store.recordings
    mend = "" if store.is_imported else "; the same sweep with record=1 rerun=all does that"
    typer.echo(f"watch: {f'kerv view {recordings[0]}' if recordings else f'nothing is recorded{mend}'}")


def _print_outcome(
    outcome: Outcome, resolved: ResolvedStudy, covered: Covered, words: list[str], as_json: bool
) -> None:
    from kerv_cli.report.tables import load_study, rows_of

    store, complete = covered.store, {cell.id for cell in [*outcome.done, *outcome.reused]}
    data = load_study(store, [cell for cell in covered.cells if cell.id in complete]) if complete else None
    counts = {"run": len(outcome.done), "reused": len(outcome.reused), "failed": len(outcome.failed)}
    if as_json:
        rows = [] if data is None else rows_of(data.table)
        print_json({"study": store.name, "folder": store.root, "cells": counts, "settings": rows,
                    "recordings": store.recordings})  # fmt: skip
    else:
        if data is not None:
            print_study(data.table, store, words)
        episodes, minutes = sum(len(cell.seeds) for cell in outcome.done), outcome.seconds / 60
        if episodes and minutes:
            typer.echo(f"{episodes} episodes in {minutes:.1f} min: {episodes / minutes:.0f} per minute")
        typer.echo(f"{counts['run']} cells run, {counts['reused']} reused, {counts['failed']} failed")
        if data is not None and not outcome.failed:
            with at_work("writing the page"):
                from kerv_cli.report.report import write_study

                # the study may hold tasks of other sweeps
                is_whole = [cell.id for cell in data.plan.cells] == [cell.id for cell in store.read_plan().cells]
                write_study(store, data if is_whole else load_study(store), resolved.sweep.loss)
            print_verdict(data.table, store, resolved.sweep.loss)
    for failure in outcome.failed:
        typer.echo(f"kerv: {failure.cell.label} on {failure.cell.task}: {failure.reason}", err=True)
