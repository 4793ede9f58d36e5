"""`kerv runs`: list, show, remove and export runs: sweeps, rollouts and trainings."""

from __future__ import annotations

from dataclasses import asdict
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kerv_cli.base.errors import Interrupted, UsageError
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import (
    AsJson,
    database_of,
    end_with_json,
    print_rows,
    print_table,
    results_word,
)

if TYPE_CHECKING:
    from kerv_cli.catalogue.entries import RunEntry


Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask; names must be whole.")]
Folder = Annotated[Path | None, typer.Option("--dir", help="Folder to write to; default results/exports.")]


def _run_names(names: list[str], most: int = 1) -> list[str]:
    from kerv_cli.episodes.resolve import study_name

    if not 1 <= len(names) <= most:
        raise UsageError("name a run: 'kerv runs list' shows them")
    return list(map(study_name, names))


@command("runs list", writes=False)
def list_(settings: CommandSettings, names: list[str], as_json: AsJson = False) -> None:
    """List the runs of a results folder, the newest first.

    NAME: kind=, method=, task=, state= and results=DIR narrow the list.

    Examples:
        kerv runs list
        kerv runs list kind=rollout method=ar
    """
    from kerv_cli.catalogue.entries import few, find_runs, matching

    filters = dict(word.partition("=")[::2] for word in names)
    runs = matching(find_runs(database_of(settings)), filters)
    if as_json:
        end_with_json(list(map(_entry_row, runs)))
    if not runs:
        typer.echo(f"no runs in {settings.results}" + (" that agree" if names else ""))
        return
    rows = []
    for run in runs:
        about = run.id, run.kind, run.started.replace("T", " ")[:16], run.state, few(run.methods), few(run.tasks)
        success = f"{run.figures['success']:.0%}" if "success" in run.figures else ""
        rows.append((*about, run.episodes or "", success))
    print_table(("run", "kind", "started, UTC", "state", "methods", "tasks", "episodes", "success"), rows)


def _entry_row(run: RunEntry) -> dict[str, object]:
    return {**asdict(run), "command": ["kerv", *run.command] if run.command else []}


@command("runs show", writes=False)
def show(settings: CommandSettings, names: list[str], as_json: AsJson = False) -> None:
    """Show one run, ID or ID:SETTING: its command, its results, the artifacts it was made from, its folder.

    NAME: runs (id, a unique part of it, or last) and results=DIR.

    Examples:
        kerv runs show last
        kerv runs show main --json
    """
    from kerv_cli.catalogue.entries import disk_bytes, find_run, find_runs, parents, store_of
    from kerv_cli.catalogue.episodes import totals

    database, (name,) = database_of(settings), _run_names(names)
    identifier, _, label = name.partition(":")
    run = find_run(database, identifier)
    rows = totals(store_of(run, database)) if run.has_episodes else []
    chosen = [row for row in rows if label in ("", row.label)]
    if label and not chosen:
        raise UsageError(f"run {run.id} has no setting '{label}': it has {', '.join(row.label for row in rows)}")
    size, origin = disk_bytes(run.folder), parents(run, find_runs(database))
    if as_json:
        content = {**_entry_row(run), "made_from": origin, "bytes": size}
        end_with_json({**content, "settings": [dict(row._mapping) for row in chosen]})
    lines = {"run": run.id, "kind": run.kind, "state": run.state, "started": run.started, "folder": run.folder}
    lines["size"] = f"{size / 1e6:.1f} MB"
    lines["command" if run.has_episodes else "made by"] = run.command_line or "unknown"
    if origin:
        lines["made from"] = ", ".join(map(" ".join, origin.items()))
    for word, value in lines.items():
        typer.echo(f"{word:<9} {value}")
    if chosen:
        print_rows(list(map(_total_row, chosen)))
        typer.echo(f"intervals and speeds: kerv report study={run.id}{results_word(database.words)}")
    elif run.figures:
        print_table(("measure", "value"), ((name, f"{value:.4g}") for name, value in run.figures.items()))


def _total_row(row: Any) -> dict[str, object]:
    from kerv_cli.report.statistics import wilson

    success = wilson(row.successes, row.episodes)
    timed = row.seconds is not None and row.steps
    return {
        "setting": row.label,
        "success": f"{success.value:.0%} ({success.low:.0%}–{success.high:.0%})",
        "episodes": row.episodes,
        "steps per episode": f"{row.steps / row.episodes:.0f}",
        "forwards per step": f"{row.forwards / max(1, row.steps):.3g}",
        "ms per step": f"{1000 * row.seconds / row.steps:.3g}" if timed else None,
    }


@command("runs rm")
def rm(settings: CommandSettings, names: list[str], yes: Yes = False) -> None:
    """Remove runs and everything in their folders, after asking for confirmation.

    NAME: runs (id, a unique part of it, or last) and results=DIR.

    Examples:
        kerv runs rm last
        kerv runs rm main --yes
    """
    from kerv_cli.catalogue.entries import check_removable, disk_bytes, find_run, remove

    database = database_of(settings)
    runs, total = [], 0
    for name in _run_names(names, 1000):
        runs.append(find_run(database, name, exact=yes))
        check_removable(runs[-1])
        total += disk_bytes(runs[-1].folder)
    what = f"{', '.join(map(attrgetter('id'), runs))} ({total / 1e6:.1f} MB)"
    try:
        sure = yes or typer.confirm(f"remove {what}?", err=True)
    except typer.Abort:  # Ctrl-C, or nobody to ask
        typer.echo(err=True)
        raise Interrupted("nothing is removed; --yes asks no question") from None
    if not sure:
        raise typer.Exit(1)
    for run in runs:
        remove(run, database)
    typer.echo(f"removed {what}")


@command("runs export", writes=False)
def export(settings: CommandSettings, names: list[str], folder: Folder = None, as_json: AsJson = False) -> None:
    """Write the episodes of a run as CSV.

    NAME: runs (id, a unique part of it, or last) and results=DIR.

    Examples:
        kerv runs export last
        kerv runs export main --dir exports
    """
    from kerv_cli.base.files import write_text
    from kerv_cli.catalogue.entries import find_run, store_of
    from kerv_cli.lab.store import frame_of, how_to_run

    (name,) = _run_names(names)
    database = database_of(settings)
    run = find_run(database, name)
    store = store_of(run, database)
    episodes = frame_of(store)
    if episodes.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {how_to_run(store)}")
    path = (folder or database.results / "exports") / f"{run.id}.csv"
    episodes = episodes.drop(columns=["episode", "decode_seconds", "initial_state"])
    write_text(path, episodes.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    if as_json:
        end_with_json({"folder": path.parent, "written": [path]})
    typer.echo(path)
