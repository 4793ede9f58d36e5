"""`kerv report`: tables, plots and a page from the episodes of a results folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from kerv_cli.base.limits import number, setting
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json


@dataclass
class ReportSettings(CommandSettings):
    """Settings of `kerv report`."""

    only: str | None = setting(None, "one study, by name or file; default: all studies in the results folder")
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


AllColumns = Annotated[bool, typer.Option("--all", help="Print all columns of the table, in several parts if needed.")]


@command(
    "report",
    ReportSettings,
    keys="study results on baseline loss",
    examples=("kerv report study=demo", "kerv report --choose study=threshold loss=5"),
    # renamed, because Hydra would take study= as a choice among the files of conf/study
    typed={"study": "only"},
)
def report(
    settings: ReportSettings,
    publish: Publish = False,
    choose: Choose = False,
    all_columns: AllColumns = False,
    as_json: AsJson = False,
) -> None:
    """Write CSV tables (per task and aggregated), plots and an HTML page about the studies."""
    from kerv_cli.cli.studies import print_prices, print_study, print_verdict
    from kerv_cli.episodes.resolve import study_name
    from kerv_cli.lab.database import opened
    from kerv_cli.lab.store import StudyStore
    from kerv_cli.report.report import report as write_report
    from kerv_cli.report.tables import rows_of

    settings.only = settings.only and study_name(settings.only)
    if choose:
        _print_choice(settings, as_json)
        return
    database = opened(settings.results)
    output = write_report(database, settings.only, publish, settings.on, settings.loss, settings.baseline)
    if as_json:
        tables = {name: rows_of(table) for name, table in output.tables.items()}
        priced = {} if output.priced is None else {"priced": rows_of(output.priced)}
        end_with_json({"files": output.files, "studies": tables, "acceptance": output.acceptance, **priced})
    for name, table in output.tables.items():
        print_study(table, StudyStore(database, name), all_columns, "--all")
    print_prices(output.priced)
    for name, table in output.tables.items():
        if settings.only is None:
            typer.echo(name)
        print_verdict(table, StudyStore(database, name), settings.loss)


def _print_choice(settings: ReportSettings, as_json: bool) -> None:
    """Print which setting to use in the chosen study, or in each study with results."""
    from kerv_cli.lab.database import opened
    from kerv_cli.lab.store import StudyStore
    from kerv_cli.report.decide import choices
    from kerv_cli.report.report import names_to_report
    from kerv_cli.report.tables import load_study
    from kerv_cli.report.verdict import sentence, short_sentence

    database, answers = opened(settings.results), {}
    for name in names_to_report(database, settings.only):
        data = load_study(StudyStore(database, name))
        groups = choices(data.table, data.per_task, settings.loss)
        answers[name] = [choice.as_dict() for choice in groups]
        if not as_json:
            front = f", not beaten in speed and success at once: {', '.join(groups[0].front)}"
            typer.echo(f"{name}{front if groups[0].front else ''}")
            typer.echo(f"  {sentence(groups[0], settings.loss, data.study.baseline)}")
            for choice in groups[1:]:
                typer.echo(f"  {short_sentence(choice)}")
    if as_json:
        end_with_json(answers)
