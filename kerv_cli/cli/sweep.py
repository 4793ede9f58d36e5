"""`kerv sweep`: run a study, which compares several settings on the same tasks and seeds."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import typer

from kerv_cli.base.config import compose, expand, groups, split
from kerv_cli.base.durations import count
from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.cli.command import Cfg, command
from kerv_cli.cli.common import AsJson, ShowPlan, end_with_json, print_rows, progress_bar
from kerv_cli.cli.studies import (
    announce,
    check_installed,
    event_printer,
    print_prices,
    print_settings,
    print_study,
    print_study_plan,
    print_verdict,
)
from kerv_cli.episodes.settings import RolloutSettings, SweepSettings

if TYPE_CHECKING:
    from kerv_cli.lab.plan import Episode
    from kerv_cli.lab.store import Study
    from kerv_cli.lab.work import Outcome
    from kerv_cli.report.tables import StudyData


@command(
    "sweep",
    SweepSettings,
    keys="study task episodes policy rerun loss runtime.workers runtime.launch results",
    each="rollout",
)
def sweep(overrides: list[str], cfg: Cfg = False, show_plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Run a study: every setting on every task with the same seeds, in turn. Existing episodes are reused.

    Without study= it lists all studies. The same command continues an interrupted study.

    Examples:
        kerv sweep study=demo
        kerv sweep study=threshold task=[reach,push] episodes=5 --plan
    """
    if not cfg and not any(word.split("=")[0].split(".")[0] == "study" for word in overrides):
        others = [word for word in overrides if not word.startswith(("results=", "store="))]
        if others:
            raise UsageError(f"{' '.join(others)} of which study? name one, study=NAME: 'kerv sweep' lists them; "
                             "'kerv rollout -m' runs a grid of your own")  # fmt: skip
        _list_studies(as_json)
        return
    from kerv_cli.episodes.resolve import resolve

    resolved = resolve(overrides)
    if cfg:
        print_settings(resolved)
        return
    announce(resolved)
    from kerv_cli.lab.database import opened
    from kerv_cli.lab.study import check, plan, save
    from kerv_cli.lab.work import EpisodeRunner, follow
    from kerv_cli.lab.workers import TimeLeft, begun, workers
    from kerv_cli.report.viewing import save_recording

    try:
        settings = check(resolved)
    except KervError as error:
        if resolved.study.first:
            typed = shlex.join(["sweep", *(word for word in overrides if word.startswith("study="))])
            error.args = (f"{error}; 'kerv {typed} --cfg' lists under first: what to run before",)
        raise
    planned = plan(resolved, settings, opened(resolved.first.results), ["sweep", *overrides])
    check_installed(planned, resolved)
    study, guess = planned.study, resolved.study.seconds
    if show_plan:
        print_study_plan(planned, as_json, guess)
        return
    with begun(planned) as run, progress_bar("episodes", has_estimate=True) as show:
        save(planned, run.id)
        with workers(planned, run.id, partial(typer.echo, err=True)) as tend:
            on_event = event_printer(show, TimeLeft(planned, guess))
            outcome = follow(planned, run, tend, EpisodeRunner(study.rollouts, save_recording), on_event)
    data = tables(study, outcome)
    print_outcome(study, outcome, data, as_json)
    write(study, outcome, data, resolved.sweep.loss)
    raise typer.Exit(int(bool(outcome.failed)))


def _list_studies(as_json: bool) -> None:
    from kerv_cli.episodes.resolve import tasks_of

    rows = []
    for name in groups()["study"]:
        study = compose("sweep", [f"study={name}"], SweepSettings).study
        common = compose("rollout", split(study.common), RolloutSettings)
        grids = [expand(split(text)) for text in study.settings.values()]
        settings, tasks = sum(map(len, grids)), len(tasks_of(common))
        counts = {"settings": settings, "tasks": tasks, "episodes": common.episodes}
        rows.append({"study": name, **counts, "in all": settings * tasks * common.episodes, "title": study.title})
    if as_json:
        end_with_json(rows)
    print_rows(rows, "episodes: per task; in all: settings x tasks x episodes")
    typer.echo("run one, e.g.: kerv sweep study=demo; what it would do: --plan")


def is_whole(study: Study, episodes: Sequence[Episode]) -> bool:
    """Return whether these are all episodes of the stored study, which may have more tasks from earlier sweeps."""
    from kerv_cli.lab.store import counts_of

    return len(episodes) == counts_of(study)[1]


def tables(study: Study, outcome: Outcome) -> StudyData | None:
    """Read the results of a sweep's episodes, of a whole study as `kerv report` does. None if no episode has ended."""
    from kerv_cli.report.tables import load_study

    failed = {one for failure in outcome.failed for one in failure.episodes}
    there = [one for one in study.episodes if one not in failed]
    return load_study(study, None if is_whole(study, there) else there) if there else None


def print_outcome(study: Study, outcome: Outcome, data: StudyData | None, as_json: bool) -> None:
    """Print the errors, the table and the counts of a sweep. With `as_json`, end the command."""
    failed = sum(len(failure.episodes) for failure in outcome.failed)
    counts = {"run": len(outcome.done), "reused": len(outcome.reused), "failed": failed}
    for failure in outcome.failed:
        one = failure.episodes[0]
        typer.echo(f"kerv: {one.setting.label} on {one.task}: {failure.reason}", err=True)
    if as_json:
        content = {"study": study.name, "folder": study.root, "episodes": counts}
        content["settings"] = [] if data is None else [row.columns() for row in data.results]
        end_with_json({**content, "recordings": study.recordings}, code=int(bool(failed)))
    if data is not None:
        print_study(data)
    minutes = outcome.seconds / 60
    if outcome.done and minutes:
        rate = len(outcome.done) / minutes
        typer.echo(f"{count(len(outcome.done), 'episode')} in {minutes:.1f} min: {rate:.0f} per minute")
    typer.echo(", ".join(f"{number} {what}" for what, number in counts.items()))


def write(study: Study, outcome: Outcome, data: StudyData | None, loss: float) -> None:
    """Write the report of a complete study, and print its verdict."""
    from kerv_cli.report.report import write_study
    from kerv_cli.report.tables import load_study

    if data is None or outcome.failed:
        return
    report = write_study(data if is_whole(study, data.study.episodes) else load_study(study), loss)
    print_prices(report.priced)
    print_verdict(report)
