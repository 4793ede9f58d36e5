"""`kerv view`: open rollouts in Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kerv_cli.cli.common import ShowConfig, composed, edge


@edge
def view(
    arguments: Annotated[
        list[str] | None, typer.Argument(help="Recordings (.rrd) or folders of them, and results=DIR.")
    ] = None,
    cfg: ShowConfig = False,
    together: Annotated[bool, typer.Option("--together", help="Show two recordings of one seed side by side.")] = False,
    summary: Annotated[bool, typer.Option("--summary", help="Print what a recording holds instead.")] = False,
) -> None:
    """Open recordings in the Rerun viewer; without a display, print the command that does."""
    from kerv_cli.base.settings import ViewSettings

    words = arguments or []
    overrides = [w for w in words if w.split("=", 1)[0] == "results" and "=" in w]
    settings = composed("view", overrides, ViewSettings, cfg, writes=False)
    from kerv_cli.report.viewing.viewer import find_recordings, open_recording, read_summary

    places = [Path(w) for w in words if w not in overrides] or [Path(settings.results)]
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
