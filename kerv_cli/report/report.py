"""Write the tables, plots and web page of each study, from its stored episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.files import write_bytes, write_json, write_text
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import ROLLOUT, StudyStore, studies
from kerv_cli.report.page import LOSS, figures_of, render
from kerv_cli.report.plots import about, png
from kerv_cli.report.reprice import open_profiles, own_prices, repriced_table
from kerv_cli.report.stressed import is_stressed, summed_table
from kerv_cli.report.tables import CSV_COLUMNS, StudyData, csv_text, further_of, latency_table, load_study, values_of


def names_to_report(database: Database, study: str | None) -> list[str]:
    """Return the names of the studies to report.

    Args:
        database: The database.
        study: Name of one study. None: every study that has at least one episode.

    Raises:
        UsageError: No study has an episode.
    """
    present = [] if study else [one for one in studies(database) if one.kind != ROLLOUT and one.counts()[0]]
    names = [study] if study else sorted(store.name for store in present)
    if not names:
        raise UsageError(f"no study in {database.results} has an episode: run `kerv sweep study=demo`")
    return names


@dataclass
class Report:
    """What `report` wrote and computed.

    Attributes:
        files: Written files, in the order of writing.
        tables: The table of each study, by the study's name.
        acceptance: How many draft tokens were accepted, by place (`Tally.as_dict`), by study and setting.
        priced: The study's speeds on other machines, from `repriced_table`. None if `on` was empty.
    """

    files: list[Path]
    tables: dict[str, pd.DataFrame]
    acceptance: dict[str, dict[str, dict[str, Any]]]
    priced: pd.DataFrame | None = None


def report(
    database: Database,
    study: str | None = None,
    publish: bool = False,
    on: Sequence[str] = (),
    loss: float = LOSS,
    baseline: str = "",
) -> Report:
    """Write the tables, plots and page of one study, or of every study that has an episode.

    The tables are <study>.csv, <study>_per_task.csv, <study>.json and, with `on`, <study>_on.csv. The same episodes
    give the same bytes.

    Args:
        database: The database. Files are written to its results folder.
        study: Name of the study. None: all studies.
        publish: Write tables and plots into the results folder itself instead of its report/. Refused for studies that
            do not meet the conditions for publishing.
        on: Names of cost profiles of other machines. The study's speeds on each are estimated (docs/measuring.md).
        loss: Largest loss of success, in points, that the verdict on the page accepts.
        baseline: Label of the setting to compare with, in place of the study's baseline.

    Raises:
        UsageError: There is no such study or setting, or nothing to report. The message names what to run.
        Unpublishable: The study may not be published. None of its files is written.
        CheckpointError: The database is damaged.
        StorageError: The disk is full or read-only.
    """
    if (on or baseline) and not study:
        given = f"on={','.join(on)}" if on else f"baseline={baseline}"
        raise UsageError(f"{given}: name the study with study=NAME")
    names = names_to_report(database, study)
    profiles, output = open_profiles(database.results, on), Report([], {}, {})
    for name in names:
        store = StudyStore(database, name)
        data = load_study(store)
        data = data.compared_with(baseline) if baseline else data
        output.priced = repriced_table(data, store, profiles) if profiles else own_prices(data, store)
        output.files += write_study(store, data, loss, publish, output.priced)
        output.tables[name] = data.table
        output.acceptance[name] = {label: tally.as_dict() for label, tally in data.tallies.items()}
    return output


def write_study(
    store: StudyStore, data: StudyData, loss: float, publish: bool = False, priced: pd.DataFrame | None = None
) -> list[Path]:
    """Write the tables, plots and page of one study. Return the files, the page last.

    Args:
        store: The study's files.
        data: The study with all its episodes.
        loss: Largest loss of success, in points, that the verdict accepts.
        publish: Write tables and plots into the results folder itself instead of its report/.
        priced: The study's speeds on other machines, from `repriced_table`. None: leave them out.

    Raises:
        Unpublishable: `publish` is set and the study may not be published.
        StorageError: The disk is full or read-only.
    """
    results, name, title = store.database.results, data.study.name, data.study.title or store.name
    if publish:
        check_publishable(data)
    tables = {"": data.table[list(CSV_COLUMNS)], "_per_task": data.per_task[list(CSV_COLUMNS)]}
    if priced is not None:
        tables["_on"] = priced
    if len(latencies := latency_table(data.table)):
        tables["_latency"] = latencies
    if is_stressed(data.table):
        tables["_summed"] = summed_table(data.table)
    folder, page = results if publish else results / "report", store.root / "report.html"
    texts = {folder / "tables" / f"{name}{suffix}.csv": csv_text(table) for suffix, table in tables.items()}
    for path, text in texts.items():
        write_text(path, text)
    document = folder / "tables" / f"{name}.json"
    write_json(document, further_of(data))
    pictures = []
    for suffix, figure in figures_of(data, loss).items():
        pictures.append(folder / "plots" / f"{name}{suffix}.png")
        write_bytes(pictures[-1], png(figure, title, about(data.table)))
    write_text(page, render(store, data, loss, priced, list(texts)))
    return [*texts, document, *pictures, page]


class Unpublishable(KervError):
    """A study does not meet the conditions for publishing."""


def refusals(table: pd.DataFrame) -> list[str]:
    """Return the reasons why a study's table may not be published, as clauses of an error message. Empty if it may."""
    clauses = []
    commits = values_of(table, "git_commit")
    if any(commit.endswith("+changes") or commit in ("none", "nan", "") for commit in commits):
        clauses.append("some episodes were computed by code that is not committed")
    several = {"git_commit": "commits", "host": "machines", "device_name": "devices", "engine": "engines"}
    for column, what in several.items():
        if len(values_of(table, column)) > 1:
            clauses.append(f"its episodes are from {len(values_of(table, column))} {what}")
    compared = table[(table["label"] != table["baseline"]) & (table["pairs"] > 0)]
    for column, what in (("same_run", "in one run with"), ("same_block", "in turn with")):
        if apart := list(dict.fromkeys(compared.loc[compared[column] < 1, "label"])):
            clauses.append(f"not measured {what} the baseline: {', '.join(map(str, apart))}")
    return clauses


def check_publishable(data: StudyData) -> None:
    """Refuse to publish a study whose episodes are incomplete or for which `refusals` gives a reason.

    Raises:
        Unpublishable: The message lists all reasons.
    """
    clauses = [f"{len(data.absent)} of its episodes are missing"] if data.absent else []
    clauses += refusals(data.table)
    if clauses:
        raise Unpublishable(
            f"study {data.study.name} may not be published: {'; '.join(clauses)}. Commit, then run it on one "
            f"machine: 'kerv sweep study={data.study.name} results=fresh'"
        )
