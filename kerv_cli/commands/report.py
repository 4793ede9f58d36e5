"""`kerv report`: tables, plots and a page from the cells of a results folder."""

from __future__ import annotations

from typing import Annotated

import typer

from kerv_cli.commands.common import Overrides, ShowConfig, composed, console, edge

Publish = Annotated[
    bool,
    typer.Option(
        "--publish", help="Write tables and plots where they are committed; refuse what may not be published."
    ),
]


@edge
def report(overrides: Overrides = None, cfg: ShowConfig = False, publish: Publish = False) -> None:
    """Write CSV tables (per task and aggregated), plots and an HTML page of the studies."""
    from kerv_cli.settings import ReportSettings

    # here study=NAME is a folder of results; to Hydra it would be a choice among the files of conf/study
    words = [f"only={o[6:]}" if o.startswith("study=") else o for o in overrides or []]
    settings = composed("report", words, ReportSettings, cfg)
    from kerv_cli.places import results_dir
    from kerv_cli.reporting.agreement import agreement_summary
    from kerv_cli.reporting.report import report as write_report
    from kerv_cli.reporting.summary import summary_table

    written = write_report(results_dir(settings.results), settings.only, publish, settings.against)
    for table in written.tables.values():
        console().print(summary_table(table))
    if written.agreement is not None:
        console().print(agreement_summary(written.agreement))
    for path in written.files:
        typer.echo(str(path))
