"""`kerv report`: tables, plots and a page from the episodes of a results folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kerv_cli.base.limits import number, setting
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json

if TYPE_CHECKING:
    from kerv_cli.lab.database import Database
    from kerv_cli.report.reprice import Priced


@dataclass
class ReportSettings(CommandSettings):
    """Settings of `kerv report`."""

    study: str | None = setting(None, "one study, by name or file; default: all studies in the results folder")
    on: list[str] = setting([], "profiles of 'kerv bench': estimate the study's times on those machines")
    baseline: str = setting("", "label of the setting to compare with; empty: the study's baseline")
    loss: float = number(3.0, above=0, most=99.9, help="largest loss of success that is accepted, percentage points")


Publish = Annotated[
    bool,
    typer.Option(
        "--publish", help="Write to tables/ and plots/ of the results; refuse studies that may not be published."
    ),
]


Choose = Annotated[
    bool, typer.Option("--choose", help="Say which setting to use: the Pareto front, and the fastest one within loss=.")
]


Explain = Annotated[bool, typer.Option("--explain", help="Say in ten words what each setting of the table is.")]


AllColumns = Annotated[bool, typer.Option("--all", help="Print all columns of the table, in several parts if needed.")]


@command("report", ReportSettings, keys="study results on baseline loss")
def report(
    settings: ReportSettings,
    publish: Publish = False,
    choose: Choose = False,
    all_columns: AllColumns = False,
    explain: Explain = False,
    as_json: AsJson = False,
) -> None:
    """Write CSV tables (per task and aggregated), plots and an HTML page about the studies.

    Examples:
        kerv report study=demo
        kerv report --choose study=threshold loss=5
    """
    from kerv_cli.cli.studies import print_prices, print_study, print_verdict
    from kerv_cli.episodes.resolve import study_name
    from kerv_cli.lab.database import opened
    from kerv_cli.report.report import report as write_reports
    from kerv_cli.report.reprice import prices_table

    study, database = settings.study and study_name(settings.study), opened(settings.results)
    if choose:
        _print_choice(database, study, settings.loss, as_json)
        return
    reports = write_reports(database, study, publish, settings.on, settings.loss, settings.baseline)
    if as_json:
        files: list[Path] = []
        priced: list[Priced] = []
        studies, acceptance = {}, {}
        for one in reports:
            files += one.files
            priced += one.priced
            studies[one.data.name] = one.data.table
            acceptance[one.data.name] = {label: tally.as_dict() for label, tally in one.data.tallies.items()}
        prices = {"priced": prices_table(priced)} if priced else {}
        end_with_json({"files": files, "studies": studies, "acceptance": acceptance, **prices})
    for one in reports:
        print_study(one.data, all_columns, "--all", explain)
    for one in reports:
        print_prices(one.priced)
    for one in reports:
        if study is None:
            typer.echo(one.data.name)
        print_verdict(one)


def _print_choice(database: Database, study: str | None, loss: float, as_json: bool) -> None:
    """Print which setting to use in the chosen study, or in each study with results."""
    from kerv_cli.report.report import to_report
    from kerv_cli.report.tables import load_study
    from kerv_cli.report.verdict import choices, sentence, short_sentence

    answers = {}
    for store in to_report(database, study):
        data = load_study(store)
        whole, *tasks = choices(data.results, data.task_results, loss)
        answers[store.name] = [choice.as_dict() for choice in (whole, *tasks)]
        if not as_json:
            front = f", not beaten in speed and success at once: {', '.join(whole.front)}"
            typer.echo(f"{store.name}{front if whole.front else ''}")
            typer.echo(f"  {sentence(whole, loss, data.study.baseline)}")
            for choice in tasks:
                typer.echo(f"  {short_sentence(choice)}")
    if as_json:
        end_with_json(answers)
