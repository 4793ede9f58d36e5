"""`kerv view`: open rollouts in Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kerv_cli.base.settings import ViewSettings
from kerv_cli.cli.command import command

Together = Annotated[bool, typer.Option("--together", help="Show two recordings of one seed side by side.")]
Summary = Annotated[bool, typer.Option("--summary", help="Print what a recording holds instead.")]


@command(
    "view",
    ViewSettings,
    keys="results",
    examples=("kerv view", "kerv view --summary results/rollouts"),
    names="NAME: recordings (.rrd) or folders of them, and results=DIR.",
    writes=False,
)
def view(settings: ViewSettings, names: list[str], together: Together = False, summary: Summary = False) -> None:
    """Open recordings in the Rerun viewer; without a display, print the command that does."""
    from kerv_cli.report.viewing.viewer import find_recordings, open_recording, read_summary

    places = [Path(name) for name in names] or [Path(settings.results)]
    if together:
        from kerv_cli.base.places import check_writable, results_dir
        from kerv_cli.report.viewing.together import save_together

        check_writable(settings.results)
        places = [save_together(places, results_dir(settings.results) / "together")]
    recordings = find_recordings(places)
    if summary:
        for recording in recordings:
            typer.echo(read_summary(recording))
        return
    typer.echo(open_recording(recordings))
