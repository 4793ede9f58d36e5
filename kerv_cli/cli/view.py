"""`kerv view`: open recordings of episodes in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path

import typer

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import database_of


@command("view", writes=False)
def view(settings: CommandSettings, names: list[str]) -> None:
    """Open recordings in the Rerun viewer; without a display, print the command that opens them.

    NAME: runs (id, a unique part of it, or last), recordings (.rrd) or folders of them, and results=DIR.

    Examples:
        kerv view last
        kerv view NAME.rrd
    """
    from kerv_cli.report.viewing.viewer import find_recordings, open_recording

    paths = [_place(settings, name) for name in names]
    typer.echo(open_recording(find_recordings(paths or filter(Path.is_dir, [Path(settings.results)]))))


def _place(settings: CommandSettings, name: str) -> Path:
    path = Path(name).expanduser()
    if path.exists() or path.suffix == ".rrd":
        return path
    from kerv_cli.catalogue.entries import LAST, find_run, find_runs
    from kerv_cli.report.viewing.viewer import NO_RECORDINGS, recordings_below

    database = database_of(settings)
    if name == LAST:
        for run in find_runs(database):
            if run.has_episodes and any(recordings_below(run.folder)):
                return run.folder
        return Path(settings.results)
    try:
        folder = find_run(database, name).folder
    except UnknownName:
        if len(path.parts) > 1:
            return path
        raise
    if not folder.is_dir():
        raise UsageError(NO_RECORDINGS.format(folder))
    return folder
