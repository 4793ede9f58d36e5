"""`kerv work`: run episodes that a sweep has planned. Any number of processes may do so at once."""

from __future__ import annotations

import typer

from kerv_cli.base.durations import count
from kerv_cli.base.errors import Interrupted, UsageError
from kerv_cli.cli.command import command
from kerv_cli.cli.studies import event_printer
from kerv_cli.episodes.settings import WorkSettings


@command("work", WorkSettings, keys="study results")
def work(settings: WorkSettings) -> None:
    """Run episodes that 'kerv sweep' has planned, until none is left; on any machine, as often as you like.

    Examples:
        kerv work study=demo
        kerv work study=main store=postgresql://me@server/kerv
    """
    from kerv_cli.base.processes import end_with_input
    from kerv_cli.episodes.resolve import study_name
    from kerv_cli.lab.database import opened
    from kerv_cli.lab.store import Study

    if not settings.study:
        raise UsageError("of which study? name one, study=NAME: 'kerv runs list' shows them")
    if settings.run:
        end_with_input()
    from kerv_cli.lab.work import EpisodeEnd, Event, work_on
    from kerv_cli.report.viewing import save_recording

    ended = 0
    show = event_printer(lambda done, total, text: None)

    def on_event(event: Event) -> None:
        nonlocal ended
        ended += isinstance(event, EpisodeEnd)
        show(event)

    store = Study(opened(settings.results), study_name(settings.study))
    try:
        work_on(store, settings.run, on_event, save_recording)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted after {count(ended, 'episode')}: other workers go on") from None
    typer.echo(f"{count(ended, 'episode')} run, none of {store.name} is left")
