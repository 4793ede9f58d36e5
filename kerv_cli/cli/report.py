"""`kerv report`: tables, plots and a page from the episodes of a results folder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from kerv_cli.base.limits import number, setting
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json

if TYPE_CHECKING:
    from kerv_cli.report.reprice import Priced


@dataclass
class ReportSettings(CommandSettings):
    """Settings of `kerv report`."""

    study: str | None = setting(None, "one study, by name or file; default: all studies in the results folder")
    on: list[str] = setting([], "profiles of 'kerv bench': estimate the study's times on those machines")
    baseline: str = setting("", "label of the setting to compare with; empty: the study's baseline")
    loss: float = number(3.0, above=0, most=99.9, help="largest loss of success that is accepted, percentage points")


AllColumns = Annotated[bool, typer.Option("--all", help="Print all columns of the table, in several parts if needed.")]


@command("report", ReportSettings, keys="study results on baseline loss")
def report(settings: ReportSettings, all_columns: AllColumns = False, as_json: AsJson = False) -> None:
    """Write CSV tables (per task and aggregated) and an HTML page about the studies, and say what they show.

    Examples:
        kerv report study=demo
        kerv report study=threshold loss=5
    """
    typer.echo("loading", err=True)  # what draws charts takes seconds
    from kerv_cli.cli.studies import print_prices, print_study, print_verdict
    from kerv_cli.episodes.resolve import study_name
    from kerv_cli.lab.database import opened
    from kerv_cli.report.report import report as write_reports
    from kerv_cli.report.reprice import prices_table

    study, database = settings.study and study_name(settings.study), opened(settings.results)
    say = partial(typer.echo, err=True)
    reports = write_reports(database, study, settings.on, settings.loss, settings.baseline, say)
    if as_json:
        priced: list[Priced] = []
        content: dict[str, dict[str, object]] = {"studies": {}, "acceptance": {}}
        for one in reports:
            priced += one.priced
            content["studies"][one.data.name] = [row.columns() for row in one.data.results]
            content["acceptance"][one.data.name] = {label: tally.as_dict() for label, tally in one.data.tallies.items()}
        prices = {"priced": prices_table(priced)} if priced else {}
        end_with_json({"files": [path for one in reports for path in one.files], **content, **prices})
    for one in reports:
        print_study(one.data, all_columns, "--all")
    for one in reports:
        print_prices(one.priced)
    for one in reports:
        if study is None:
            typer.echo(one.data.name)
        print_verdict(one)
