"""`kerv board`: look at the results folder in a browser."""

from __future__ import annotations

from dataclasses import dataclass

import typer

from kerv_cli.base.limits import number, setting
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import database_of, end_at_once


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
