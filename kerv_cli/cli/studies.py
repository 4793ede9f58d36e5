"""Run studies for the commands: plan them, show their progress, print the results."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING

import typer

from kerv_cli.base.durations import about, count, duration
from kerv_cli.cli.common import (
    console,
    end_with_json,
    print_rows,
    print_table,
    progress_bar,
    results_word,
    settings_yaml,
)

if TYPE_CHECKING:
    from kerv_cli.episodes.resolve import ResolvedStudy
    from kerv_cli.lab.study import Plan
    from kerv_cli.lab.work import Event, Outcome
    from kerv_cli.lab.workers import TimeLeft
    from kerv_cli.report.report import Report
    from kerv_cli.report.reprice import Priced
    from kerv_cli.report.tables import StudyData

SECONDS_PER_EPISODE = 3.0  # a guess, while no episode was measured and no study's file says it
BUSY = 1.2  # load average per core above which a line says that other programs disturb the measured times


def announce(resolved: ResolvedStudy, is_rollout: bool = False) -> None:
    """Print the number of episodes, and the overrides that have no effect, before torch and the simulator load."""
    from kerv_cli.episodes.resolve import idle_overrides

    settings, tasks = resolved.settings, resolved.tasks
    what = next(iter(settings)) if len(settings) == 1 else f"{len(settings)} settings"
    whose = _few(list(dict.fromkeys(setting.policy.target for setting in settings.values())), "targets")
    number = len(settings) * len(tasks) * resolved.first.episodes
    for override, reason in idle_overrides(resolved, not is_rollout).items():
        typer.echo(f"note: {override} has no effect: {reason}", err=True)
    typer.echo(f"{what} of {whose} on {_few(tasks, 'tasks')}: {count(number, 'episode')}", err=True)


def check_installed(planned: Plan, resolved: ResolvedStudy) -> None:
    """Refuse tasks whose simulator is missing. Print the tasks that the policy was not trained on."""
    from kerv_cli.worlds import spec_of

    for target, names in resolved.unseen.items():
        typer.echo(f"kerv: warning: policy {target} was never trained on {', '.join(names)}", err=True)
    for task in dict.fromkeys(one.task for one in planned.to_run):
        spec_of(task).check_installed(resolved.first.policy.target)


def _few(names: Sequence[str], what: str) -> str:
    return ", ".join(names) if len(names) < 4 else f"{len(names)} {what}"


def print_settings(resolved: ResolvedStudy) -> None:
    typer.echo(settings_yaml(resolved.study), nl=False)
    for label, settings in resolved.settings.items():
        typer.echo(f"--- # {label}\n{settings_yaml(settings)}", nl=False)


def print_study_plan(planned: Plan, as_json: bool, guess: float = SECONDS_PER_EPISODE) -> None:
    """Print which episodes would run, why, and for how long. `guess`: seconds per episode if none was measured."""
    from kerv_cli.lab.workers import TimeLeft

    rows, to_run, reused, study = _plan_rows(planned), planned.to_run, planned.existing, planned.study
    left = TimeLeft(planned, guess)
    if as_json:
        end_with_json({"study": study.name, "folder": study.root, "settings": rows, "to run": len(to_run),
                       "reused": len(reused), "seconds": left.seconds, "source": left.source})  # fmt: skip
    print_rows(rows, f"study {study.name}, episodes")
    typer.echo(f"{count(len(to_run), 'episode')} to run, {len(reused)} reused, {about(left.seconds, left.source)}")


def _plan_rows(planned: Plan) -> list[dict[str, object]]:
    from kerv_cli.lab.plan import grouped, seeds_text

    of_label = grouped(planned.study.episodes, attrgetter("setting.label"))
    rows: list[dict[str, object]] = []
    for label in planned.study.labels:
        episodes = of_label[label]
        reasons = [planned.missing[one] for one in episodes if one in planned.missing]
        rows.append(
            {
                "setting": label,
                "to run": len(reasons),
                "reused": len(episodes) - len(reasons),
                "tasks": len(set(map(attrgetter("task"), episodes))),
                "seeds": seeds_text(map(attrgetter("seed"), episodes)),
                "why": "; ".join(dict.fromkeys(reasons)),
            }
        )
    return rows


def run_plan(planned: Plan, guess: float = SECONDS_PER_EPISODE) -> Outcome:
    """Run the missing episodes of a plan and show the progress, with the time left."""
    from kerv_cli.lab.workers import TimeLeft, run
    from kerv_cli.report.viewing import save_recording

    with progress_bar("episodes", has_estimate=True) as show:
        return run(planned, event_printer(show, TimeLeft(planned, guess)), write=save_recording)


def event_printer(show: Callable[[int, int, str], None], left: TimeLeft | None = None) -> Callable[[Event], None]:
    """Return a function that prints a line about each event of a running study and updates the progress bar by `show`.

    `left` estimates the time of the plan that begins now; a worker has none. If standard error is no terminal, only the
    first 100 episodes get a line each.
    """
    from kerv_cli.lab.work import BlockStarted, BlocksWait, Counted, Preparing, SettingFailed

    total = 0 if left is None else _say_what_begins(left)
    ended, title, on_terminal = 0, "starting", sys.stderr.isatty()

    def move() -> None:
        if left is not None and total:
            show(ended, total, f"about {duration(left.seconds)} left, {title}")

    def on_event(event: Event) -> None:
        nonlocal ended, title
        line = ""
        if left is not None:
            left.see(event)
        if isinstance(event, Counted):
            ended = max(0, total - event.left)
        elif isinstance(event, BlockStarted):
            title = event.block.title
        elif isinstance(event, Preparing):
            preparing = f"preparing {event.setting.label}, {event.number} of {event.of}"
            if total:
                show(ended, total, preparing)
            line = "" if ended or on_terminal else preparing
        elif isinstance(event, BlocksWait):
            waits = f"{count(event.episodes, 'episode')} left: "
            line = waits + ("other processes run them" if event.has_workers else "no worker runs them")
        elif isinstance(event, SettingFailed):
            ended += len(event.episodes)
            one = event.episodes[0]
            line = f"{one.setting.label} on {one.task}: failed: {event.reason}"
        else:
            ended += 1
            one, result = event.episode, f"{'success' if event.success else 'failure'}, {event.seconds:.1f} s"
            of_all = f"/{total}" if total else ""  # a worker does not know how many the study has
            if ended <= 100 or on_terminal:
                line = f"{ended}{of_all} {one.setting.label} on {one.task}, seed {one.seed}: {result}"
        if line:
            typer.echo(line, err=True)
        if not isinstance(event, Preparing):
            move()

    move()
    return on_event


def _say_what_begins(left: TimeLeft) -> int:
    from kerv_cli.lab.work import load_per_core

    plan, load = left.plan, load_per_core()
    if load > BUSY and plan.blocks:
        typer.echo(f"the load average is {load:g} per core: other programs slow these times", err=True)
    total, reused = len(plan.to_run), len(plan.existing)
    there = f"{count(reused, 'episode')} there already" if reused else ""
    line = ", ".join(filter(None, (there, f"{total} to run, {about(left.seconds, left.source)}" if total else "")))
    if line:
        typer.echo(line, err=True)
    return total


def print_study(data: StudyData, all_columns: bool = False, how: str = "") -> None:
    """Print the table of a study and its note. `how` is what to type to see all columns."""
    from kerv_cli.lab.store import sweep_command
    from kerv_cli.report.summary import SummaryTable, not_in_turn

    study = data.study
    how = how or f"kerv report study={study.name}{results_word(study.database.words)} --all"
    console().print(SummaryTable(data.results, all_columns, how))
    commits = {one for row in data.results for one in row.provenance["git_commit"].split(";")}
    if len(commits) > 1:
        typer.echo(f"its episodes are of {len(commits)} commits: {', '.join(sorted(one[:12] for one in commits))}")
    apart = not_in_turn(data.results)
    if apart:
        mend = sweep_command(study, "rerun=all")
        typer.echo(f"no speedup of {', '.join(apart)}: not measured in turn with the baseline; '{mend}' does that")
    if data.study.note:
        typer.echo(f"\n{data.study.note}\n")


def print_prices(priced: Sequence[Priced]) -> None:
    from kerv_cli.report.summary import ASSUMES, repriced_summary

    if priced:
        table = repriced_summary(priced)
        names = [name for name in table[0] if name.endswith(("setting", "per episode"))]  # the page has all columns
        print_table(names, ([row[name] for name in names] for row in table), ASSUMES)


def print_verdict(report: Report) -> None:
    from kerv_cli.report.verdict import caution, order_of

    data, study = report.data, report.data.study
    if order := order_of(data.by_speed):
        typer.echo(f"by speed per episode: {order}")
    if note := caution(data.results):
        typer.echo(f"note: {note}")
    typer.echo(f"verdict: {report.verdict.sentence}")
    command, time = report.to_settle
    if command:
        typer.echo(f"settle it, in about {time}: {command}")
    typer.echo(f"table: {report.files[0]}")
    typer.echo(f"page: {report.files[-1]}")
    typer.echo(f"browse: kerv board{results_word(study.database.words)}")
    recordings = study.recordings
    nothing = "nothing is recorded; the same sweep with record=1 rerun=all does that"
    typer.echo(f"watch: {shlex.join(['kerv', 'view', str(recordings[0])]) if recordings else nothing}")
