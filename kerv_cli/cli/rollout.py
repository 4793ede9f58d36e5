"""`kerv rollout`: run episodes of one method or of a grid of settings, print the results and write recordings."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from kerv_cli.base.durations import about, count
from kerv_cli.cli.command import Cfg, command
from kerv_cli.cli.common import (
    AsJson,
    ShowPlan,
    console,
    end_with_json,
    print_table,
    results_word,
    settings_yaml,
)
from kerv_cli.cli.studies import SECONDS_PER_EPISODE, planned_study, run_study
from kerv_cli.episodes.settings import RolloutSettings

if TYPE_CHECKING:
    from kerv_cli.lab.store import Study

Many = Annotated[
    bool, typer.Option("-m", "--multirun", help="Run all combinations of settings with several values (a,b).")
]


@command(
    "rollout",
    RolloutSettings,
    keys="task method policy episodes seed proposer threshold record rollout.clock world.stress.kind",
)
def rollout(
    overrides: list[str], cfg: Cfg = False, plan: ShowPlan = False, multirun: Many = False, as_json: AsJson = False
) -> None:
    """Run episodes of one method; print success, forwards, acceptance and time; record one episode per task.

    Examples:
        kerv rollout method=spec_vla task=drawer-open threshold.r=5
        kerv rollout -m method=ar,one_pass task=[reach,push] episodes=5
    """
    from kerv_cli.episodes.identity import stress_text
    from kerv_cli.episodes.resolve import resolve_rollout

    resolved = resolve_rollout(overrides, multirun)
    if cfg:
        typer.echo("---\n".join(map(settings_yaml, resolved.settings.values())), nl=False)
        return
    planned = planned_study(resolved, ["rollout", *(["-m"] if multirun else []), *overrides], is_rollout=True)
    if plan:
        names = ", ".join(f"{label}{stress_text(asdict(settings))}" for label, settings in resolved.settings.items())
        total, tasks = len(planned.episodes), resolved.tasks
        seconds = SECONDS_PER_EPISODE * total
        if as_json:
            end_with_json({"settings": list(resolved.settings), "tasks": tasks, "episodes": total, "seconds": seconds})
        typer.echo(f"{names}: {count(len(tasks), 'task')}, {count(total, 'episode')}, {about(seconds)}")
        return
    run_study(planned)
    _print_rollout(planned, as_json, results_word(overrides))


def _print_rollout(study: Study, as_json: bool, where: str) -> None:
    from kerv_cli.report.results import averaged, frame_of
    from kerv_cli.report.summary import SummaryTable, setting_tables
    from kerv_cli.report.tables import load_study

    data = load_study(study)
    if as_json:
        end_with_json({"run": study.name, "folder": study.root, "settings": frame_of(averaged(data.results)),
                       "tasks": data.per_task, "recordings": study.recordings})  # fmt: skip
    if len(data.study.labels) > 1:
        console().print(SummaryTable(data.results))
    else:
        for table in setting_tables(data):
            print_table(*table)
    show = f"kerv runs show {study.name}{where}"
    typer.echo(f"run {study.name} in {study.root}; its settings and figures: {show}")
    if study.recordings:
        first = shlex.quote(str(study.recordings[0]))
        typer.echo(f"{count(len(study.recordings), 'recording')}; open one with: kerv view {first}")
