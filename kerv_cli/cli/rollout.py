"""`kerv rollout`: episodes of one method or of a grid, their figures and their Rerun files."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from kerv_cli.base.durations import about
from kerv_cli.cli.command import command
from kerv_cli.cli.common import (
    AsJson,
    ShowPlan,
    console,
    print_json,
    print_notes,
    print_table,
    results_word,
    settings_yaml,
)
from kerv_cli.cli.episodes import count, planned_rollout, run_study
from kerv_cli.episodes.settings import RolloutSettings

if TYPE_CHECKING:
    from kerv_cli.episodes.identity import Plain
    from kerv_cli.lab.store import StudyStore
    from kerv_cli.report.measures import Row
    from kerv_cli.report.tables import StudyData

Many = Annotated[bool, typer.Option("-m", "--multirun", help="Comma lists form a grid; every point is run.")]


@command(
    "rollout",
    RolloutSettings,
    keys="task method policy episodes seed proposer threshold record rollout.clock world.stress.kind",
    examples=(
        "kerv rollout method=spec_vla task=drawer-open threshold.r=5",
        "kerv rollout -m method=ar,one_pass task=[reach,push] episodes=5",
    ),
)
def rollout(
    words: list[str], cfg: bool = False, plan: ShowPlan = False, multirun: Many = False, as_json: AsJson = False
) -> None:
    """Run episodes of one method; print success, forwards, acceptance and time; write one .rrd per task."""
    from kerv_cli.episodes.identity import without_effect
    from kerv_cli.episodes.resolve import resolve_rollout

    resolved = resolve_rollout(words, multirun)
    if cfg:
        typer.echo("---\n".join(settings_yaml(settings) for settings in resolved.settings.values()), nl=False)
        return
    for label, settings in resolved.settings.items():
        print_notes(without_effect(settings, resolved.points[label].overrides))
    planned = planned_rollout(resolved, ["rollout", *(["-m"] if multirun else []), *words])
    if plan:
        names = ", ".join(f"{label}{_stressed(asdict(settings))}" for label, settings in resolved.settings.items())
        total, tasks = len(planned.study.episodes), resolved.tasks
        if as_json:
            print_json({"settings": list(resolved.settings), "tasks": tasks, "episodes": total, "seconds": 3 * total})
        else:
            typer.echo(f"{names}: {count(len(tasks), 'task')}, {count(total, 'episode')}, {about(3 * total)}")
        return
    run_study(resolved, planned)
    _print_rollout(planned.store, as_json, results_word(words))


def _stressed(settings: Plain) -> str:
    """The stress in plain RolloutSettings, as text behind a setting's label; empty without one."""
    from kerv_cli.episodes.identity import stress_of

    stress = stress_of(settings)
    return f", stress {stress['kind']} {stress['level']}" if stress["level"] else ""


def _print_rollout(store: StudyStore, as_json: bool, where: str) -> None:
    from kerv_cli.report.measures import MICRO
    from kerv_cli.report.summary import SummaryTable
    from kerv_cli.report.tables import load_study, rows_of

    data = load_study(store)
    whole, per_task = rows_of(data.table, MICRO), rows_of(data.per_task)
    if as_json:
        print_json({"run": store.name, "folder": store.root, "settings": whole, "tasks": per_task,
                    "recordings": store.recordings})  # fmt: skip
        return
    if len(data.study.labels) > 1:
        console().print(SummaryTable(data.table))
    else:
        _print_setting(data, per_task, whole[0])
    show = f"kerv runs show {store.name}{where}"
    typer.echo(f"run {store.name} in {store.root}; its settings and figures: {show}")
    if store.recordings:
        typer.echo(f"{len(store.recordings)} recordings; open one with: kerv view {store.recordings[0]}")


def _print_setting(data: StudyData, per_task: list[Row], whole: Row) -> None:
    """Figures of a run with one setting: by task, and time by phase."""
    from kerv_cli.engine.record import PHASES
    from kerv_cli.episodes.identity import batch_of
    from kerv_cli.report.measures import is_timed

    episodes, setting = data.episodes, data.study.settings[0]
    by_task = {row["task"]: row for row in per_task}
    figures = [(task, by_task[task]) for task in dict.fromkeys(episodes["task"])]
    if len(figures) > 1:
        figures.append(("all", whole))
    headers = ("task", "success", "steps", "forwards/step", "tokens/verification", "drafts accepted", "ms/step")
    seeds = f"{episodes['seed'].min()}…{episodes['seed'].max()}"
    observation = setting.identity.get("observation", "")
    title = f"{setting.label}, observation {observation}{_stressed(setting.settings)}, seeds {seeds}"
    print_table(headers, ((name, *_figures(row)) for name, row in figures), title)
    if not is_timed(episodes):
        typer.echo(f"not timed: {batch_of(setting.settings)} episodes at a time, for success alone")
        return
    decodes, total = episodes["decodes"].sum(), episodes["seconds"].sum()
    seconds = {phase: episodes[f"seconds.{phase}"].sum() for phase in PHASES}
    rows = [(name, f"{1000 * s / decodes:.2f}", f"{s / total:.0%}") for name, s in seconds.items() if s]
    print_table(("phase", "ms per decode", "share"), rows, "time by phase")


def _figures(row: Row) -> list[str]:
    from kerv_cli.report.tables import is_number

    rates = (row[name] for name in ("forwards_per_step", "AL", "accepted_per_round", "time_per_step_ms"))
    successes, steps = f"{row['successes']}/{row['episodes']}", f"{row['steps'] / row['episodes']:.0f}"
    return [successes, steps, *(f"{rate:.2f}" if is_number(rate) else "–" for rate in rates)]
