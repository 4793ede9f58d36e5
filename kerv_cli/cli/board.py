"""`kerv board`: look at the results folder in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import typer

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number, setting
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, database_of, end_at_once, end_with_json, progress_bar

BOARD_FILE = "static/board.css"  # `kerv board export` replaces a folder only if it has this file or is empty


@dataclass(kw_only=True)
class BoardSettings(CommandSettings):
    """Settings of `kerv board`."""

    port: int = number(8765, 0, 65_535, help="port on this machine; 0: a free one")
    open: bool = setting(True, "open the page in the browser")


@command("board", BoardSettings, keys="port open results", writes=False)
def board(settings: BoardSettings) -> None:
    """Look at runs, studies, trainings and episodes in the browser, until Ctrl-C; only this machine can.

    Examples:
        kerv board
        kerv board port=0 open=false
    """
    from kerv_cli.board.app import serve
    from kerv_cli.report.viewing.viewer import has_display

    serve(
        database_of(settings),
        settings.port,
        lambda address: typer.echo(f"{address}  (Ctrl-C ends it)"),
        settings.open and has_display(),
    )
    end_at_once()


@command("board export", writes=False)
def export(settings: CommandSettings, names: list[str], as_json: AsJson = False) -> None:
    """Write the board as files: tables, plots, films, tokens. They open without a server and can be sent.

    NAME: a folder to write to, then runs (id, or a unique part of it; none: all), and results=DIR.

    Examples:
        kerv board export shared
        kerv board export shared papers
    """
    from kerv_cli.base.files import write_folder
    from kerv_cli.board.export import export_board
    from kerv_cli.catalogue.entries import disk_bytes, find_run

    if not names:
        raise UsageError("name a folder to write to, as in 'kerv board export shared'")
    folder, database, files = Path(names[0]).expanduser(), database_of(settings), list[Path]()
    if folder.exists() and not (folder / BOARD_FILE).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} holds other files: name another folder")
    runs = [find_run(database, name).id for name in names[1:]]
    with progress_bar("pages", has_estimate=True) as advance:  # no estimate: pages lead to further pages
        write_folder(folder, lambda new: files.extend(export_board(database, runs, new, advance)))
    size = disk_bytes(folder)
    if as_json:
        end_with_json({"folder": folder, "files": len(files), "bytes": size})
    typer.echo(f"{count(len(files), 'file')}, {size / 1e6:.1f} MB: open {folder / 'index.html'}")
