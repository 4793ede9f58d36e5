"""`kerv runs import`: take over runs of another results folder, or evaluations of vla-eval."""

from __future__ import annotations

from dataclasses import dataclass

import typer

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import setting
from kerv_cli.base.paths import as_path
from kerv_cli.base.settings import CommandSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, console, database_of, end_with_json


@dataclass(kw_only=True)
class ImportSettings(CommandSettings):
    """Settings of `kerv runs import`. They are for recordings of vla-eval, which become a study (docs/vla_eval.md)."""

    name: str = setting("", "name of the study; empty: the names of its benchmarks")
    baseline: str = setting("", "label of the setting that others are compared with; empty: ar, else the first one")
    labels: list[str] = setting([], "label of each recording, in order; empty: its method, or the name of its server")


@command(
    "runs import",
    ImportSettings,
    names="NAME: a kerv.db, vla-eval's recording-….sqlite, or folders that hold one.",
    keys="name baseline labels results",
    examples=("kerv runs import ar/recording-1.sqlite kerv/recording-2.sqlite", "kerv runs import old-results"),
)
def import_(settings: ImportSettings, names: list[str], as_json: AsJson = False) -> None:
    """Import the runs of another results folder, or evaluations of vla-eval as a study."""
    from kerv_cli.catalogue.evaluations import import_evaluations
    from kerv_cli.catalogue.imports import database_in, import_databases
    from kerv_cli.lab.store import Study
    from kerv_cli.report.summary import SummaryTable
    from kerv_cli.report.tables import load_study

    if not names:
        raise UsageError("name what to import: kerv runs import old-results, or kerv runs import recording-ID.sqlite")
    paths = list(map(as_path, names))
    files = list(filter(None, map(database_in, paths)))
    database = database_of(settings)
    if files:
        if len(files) < len(paths):
            raise UsageError("import results folders and evaluations one after the other")
        studies, notes = import_databases(database, files, settings.name)
        if as_json:
            end_with_json({"studies": studies, "notes": notes})
        for line in [*notes, f"imported {', '.join(studies) or 'nothing'}: kerv runs list"]:
            typer.echo(line)
        return
    words = ["runs", "import", *names]
    name, notes = import_evaluations(database, paths, settings.name, settings.labels, settings.baseline, words)
    data = load_study(Study(database, name))
    if as_json:
        end_with_json({"study": name, "notes": notes, "settings": data.table})
    for line in notes:
        typer.echo(line)
    console().print(SummaryTable(data.results))
    typer.echo(f"study {name}: kerv report study={name}, kerv report --choose study={name}")
