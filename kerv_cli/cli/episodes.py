"""Helpers of the commands that run episodes: plan a study, estimate its duration, run it, print the results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import typer

from kerv_cli.base.durations import about, count
from kerv_cli.cli.common import at_work, console, print_json, print_notes, print_table, settings_yaml

if TYPE_CHECKING:
    from pandas import DataFrame

    from kerv_cli.episodes.resolve import ResolvedStudy
    from kerv_cli.lab.events import Outcome
    from kerv_cli.lab.store import Plan, StudyStore
    from kerv_cli.lab.study import InterimAnalysis

SECONDS_PER_EPISODE = 1.0
"""Guess that is used before anything was measured. MT10 takes 0.5 to 1.5 s per episode on one core."""


def planned_study(resolved: ResolvedStudy, command: Sequence[str]) -> Plan:
    """Plan a study: find out which of its episodes must run. Print notes about it to standard error.

    The notes give the number of episodes, the overrides that have no effect, and the tasks that the policy was not
    trained on.

    Args:
        resolved: The study with all its settings.
        command: Command-line arguments after `kerv`, to be stored with the episodes.

    Raises:
        UsageError: The study cannot run with these settings.
        CheckpointError: The policy or an artifact that a method needs is missing or damaged.
    """
    from kerv_cli.episodes.resolve import idle_overrides

    print_notes(idle_overrides(resolved))
    _announce(resolved)
    with at_work("loading the policy"):
        from kerv_cli.lab.study import plan

        planned = plan(resolved, command)
    _warn_of_unseen(resolved)
    return planned


def planned_rollout(resolved: ResolvedStudy, command: Sequence[str]) -> Plan:
    """Plan a rollout as `planned_study` plans a study. If it continues an interrupted rollout, print that."""
    _announce(resolved)
    with at_work("loading the policy"):
        from kerv_cli.lab.study import plan_rollout

        planned = plan_rollout(resolved, command)
    _warn_of_unseen(resolved)
    if planned.existing:
        there, wanted = len(planned.existing), len(planned.study.episodes)
        typer.echo(f"resuming {planned.store.name}: {there} of {wanted} episodes are there", err=True)
    return planned


def _announce(resolved: ResolvedStudy) -> None:
    """Print the number of episodes, before torch and the simulator load."""
    settings, tasks = resolved.settings, resolved.tasks
    what = next(iter(settings)) if len(settings) == 1 else f"{len(settings)} settings"
    whose = _few(list(dict.fromkeys(setting.policy.target for setting in settings.values())), "targets")
    number = len(settings) * len(tasks) * resolved.first.episodes * resolved.study.repeats
    typer.echo(f"{what} of {whose} on {_few(tasks, 'tasks')}: {count(number, 'episode')}", err=True)


def _warn_of_unseen(resolved: ResolvedStudy) -> None:
    """Print a warning with the tasks that a policy was not trained on."""
    from kerv_cli.episodes.policy import unseen_tasks

    settings = resolved.settings.values()
    for target, names in dict.fromkeys((s.policy.target, tuple(unseen_tasks(s, resolved.tasks))) for s in settings):
        if names:
            typer.echo(f"kerv: warning: policy {target} was never trained on {', '.join(names)}", err=True)


def _few(names: Sequence[str], what: str) -> str:
    """Return up to three names as a list, or the number of names as in `10 tasks`.

    Args:
        names: The names.
        what: What they name, in plural.
    """
    return ", ".join(names) if len(names) < 4 else f"{len(names)} {what}"


def print_settings(resolved: ResolvedStudy) -> None:
    """Print a study and each of its settings as YAML. For the option --cfg."""
    typer.echo(settings_yaml(resolved.study), nl=False)
    for label, settings in resolved.settings.items():
        typer.echo(f"--- # {label}\n{settings_yaml(settings)}", nl=False)


def print_study_plan(planned: Plan, as_json: bool) -> None:
    """Print which episodes would run, why, and how long that would take. For the option --plan."""
    from kerv_cli.lab.study import estimate, plan_rows

    rows, store, to_run, reused = plan_rows(planned), planned.store, planned.to_run, planned.existing
    seconds, source = estimate(planned, SECONDS_PER_EPISODE)
    if as_json:
        print_json({"study": store.name, "folder": store.root, "settings": rows, "to run": len(to_run),
                    "reused": len(reused), "seconds": seconds, "source": source})  # fmt: skip
        return
    print_table(rows[0], (row.values() for row in rows), f"study {store.name}, episodes")
    typer.echo(f"{count(len(to_run), 'episode')} to run, {len(reused)} reused, {about(seconds, source)}")


def run_study(resolved: ResolvedStudy, planned: Plan) -> Outcome:
    """Run the missing episodes of a study and show the progress.

    With until=decided the study ends as soon as its results are clear.

    Raises:
        Interrupted: The user pressed Ctrl-C.
        KervError: The study could not run, see `study.run`.
    """
    from kerv_cli.lab.plan import seed_blocks
    from kerv_cli.report.decide import confidence_of_a_look, judge
    from kerv_cli.report.verdict import stopping_rule

    analysis = None
    if resolved.sweep.until == "decided":
        loss, looks = resolved.sweep.loss, len(seed_blocks(planned.study))
        typer.echo(stopping_rule(loss, looks, confidence_of_a_look(looks)), err=True)
        analysis = judge(loss, lambda line: typer.echo(line, err=True))
    return run_planned(planned, analysis)


def run_planned(planned: Plan, analysis: InterimAnalysis | None = None) -> Outcome:
    """Run the missing episodes of a plan and show the progress; raises as `study.run`.

    Args:
        planned: The plan.
        analysis: Decides during the study whether it can end early. None: all episodes run.
    """
    from kerv_cli.cli.progress import ProgressDisplay
    from kerv_cli.lab.study import run
    from kerv_cli.report.viewing import save_recording

    with ProgressDisplay(console(stderr=True)) as display:
        return run(planned, display, save=save_recording, on_step=display.on_step, analysis=analysis)


def print_study(table: DataFrame, store: StudyStore) -> None:
    """Print the table of a study and its note.

    If times cannot be compared, because they were not measured in turn, print the command that measures them again.

    Args:
        table: Summary with one row per setting.
        store: The study in the database.
    """
    from kerv_cli.report.summary import SummaryTable, not_in_turn
    from kerv_cli.report.tables import values_of

    console().print(SummaryTable(table))
    codes, commits = values_of(table, "code"), values_of(table, "git_commit")
    if len(codes) > 1:
        names = ", ".join(sorted(commit[:12] for commit in commits))
        typer.echo(f"its episodes are of {len(codes)} states of the code, commits {names}")
    apart = not_in_turn(table)
    if apart:
        mend = "" if store.kind == "import" else f"; '{store.sweep_command('rerun=timed')}' does that"
        typer.echo(f"no speedup of {', '.join(apart)}: not measured in turn with the baseline{mend}")
    note = store.load().note
    if note:
        typer.echo(f"\n{note}\n")


def print_verdict(table: DataFrame, store: StudyStore, loss: float) -> None:
    """Print the last three lines about a study: the verdict, the page to open, the recording to watch.

    Args:
        table: Summary with one row per setting.
        store: The study in the database.
        loss: Largest loss of success that is accepted, percentage points.
    """
    from kerv_cli.report.decide import verdict_of

    typer.echo(f"verdict: {verdict_of(table, loss)[0]}")
    typer.echo(f"page: {store.root / 'report.html'}")
    recordings = store.recordings
    mend = "" if store.kind == "import" else "; the same sweep with record=1 rerun=all does that"
    typer.echo(f"watch: {f'kerv view {recordings[0]}' if recordings else f'nothing is recorded{mend}'}")
