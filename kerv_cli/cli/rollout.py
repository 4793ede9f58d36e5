"""`kerv rollout`: run episodes of one method or of a grid of settings, print the results and write recordings."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from typing import Annotated

import typer

from kerv_cli.base.durations import about, count
from kerv_cli.cli.command import Cfg, command
from kerv_cli.cli.common import AsJson, ShowPlan, console, end_with_json, print_table, results_word, settings_yaml
from kerv_cli.cli.studies import SECONDS_PER_EPISODE, announce, check_installed, run_plan
from kerv_cli.episodes.settings import RolloutSettings

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
    announce(resolved, is_rollout=True)
    from kerv_cli.lab.database import opened
    from kerv_cli.lab.store import ROLLOUT
    from kerv_cli.lab.study import check
    from kerv_cli.lab.study import plan as plan_rollout
    from kerv_cli.lab.workers import TimeLeft

    words = ["rollout", *(["-m"] if multirun else []), *overrides]
    planned = plan_rollout(resolved, check(resolved), opened(resolved.first.results), words, ROLLOUT)
    check_installed(planned, resolved)
    study = planned.study
    if plan:
        names = ", ".join(f"{label}{stress_text(asdict(settings))}" for label, settings in resolved.settings.items())
        total, tasks, left = len(study.episodes), resolved.tasks, TimeLeft(planned, SECONDS_PER_EPISODE)
        if as_json:
            end_with_json({"settings": list(resolved.settings), "tasks": tasks, "episodes": total,
                           "seconds": left.seconds, "source": left.source})  # fmt: skip
        typer.echo(
            f"{names}: {count(len(tasks), 'task')}, {count(total, 'episode')}, {about(left.seconds, left.source)}"
        )
        return
    from kerv_cli.report.summary import SummaryTable, setting_tables
    from kerv_cli.report.tables import load_study

    run_plan(planned)
    data, name, recordings = load_study(study), study.name, study.recordings
    if as_json:
        end_with_json({"run": name, "folder": study.root, "settings": [row.columns() for row in data.results],
                       "tasks": [row.columns() for row in data.task_results], "recordings": recordings})  # fmt: skip
    if len(study.labels) > 1:
        console().print(SummaryTable(data.results))
    else:
        for table in setting_tables(data):
            print_table(*table)
    show = f"kerv runs show {name}{results_word(overrides)}"
    typer.echo(f"run {name} in {study.root}; its settings and figures: {show}")
    if recordings:
        first = shlex.quote(str(recordings[0]))
        typer.echo(f"{count(len(recordings), 'recording')}; open one with: kerv view {first}")
