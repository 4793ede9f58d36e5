"""Write the tables, plots and web page of each study, from its stored episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.files import write_bytes, write_json, write_text
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import ROLLOUT, Study, studies
from kerv_cli.report.page import LOSS, figures_of, render
from kerv_cli.report.plots import about, png
from kerv_cli.report.profiles import open_profiles
from kerv_cli.report.reprice import Priced, own_prices, prices_table, repriced
from kerv_cli.report.results import Result, csv_text
from kerv_cli.report.tables import (
    CSV_COLUMNS,
    StudyData,
    further_of,
    is_stressed,
    latency_table,
    load_study,
    split_values,
    summed_table,
)


def to_report(database: Database, study: str | None) -> list[Study]:
    """Return the studies to report.

    Args:
        database: The database.
        study: Name of one study. None: every study that has at least one episode, sorted by name.

    Raises:
        UsageError: No study has an episode.
    """
    if study:
        return [Study(database, study)]
    stores = [one for one in studies(database) if one.kind != ROLLOUT and one.counts()[0]]
    if not stores:
        raise UsageError(f"no study in {database.results} has an episode: run `kerv sweep study=demo`")
    return sorted(stores, key=lambda one: one.name)


@dataclass(frozen=True)
class Report:
    """What `report` wrote and computed about one study.

    Attributes:
        data: The study with its tables.
        priced: The study's speeds on other machines. Empty: none were estimated.
        files: Written files, in the order of writing.
    """

    data: StudyData
    priced: list[Priced]
    files: list[Path]


def report(
    database: Database,
    study: str | None = None,
    publish: bool = False,
    on: Sequence[str] = (),
    loss: float = LOSS,
    baseline: str = "",
) -> list[Report]:
    """Write the tables, plots and page of one study, or of every study that has an episode. Return a report of each.

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
    profiles, reports = open_profiles(database.results, on), []
    for store in to_report(database, study):
        data = load_study(store)
        if baseline:
            data = data.compared_with(baseline)
        priced = repriced(data, profiles) if profiles else own_prices(data)
        reports.append(Report(data, priced, write_study(data, loss, priced, publish)))
    return reports


def write_study(data: StudyData, loss: float, priced: Sequence[Priced] = (), publish: bool = False) -> list[Path]:
    """Write the tables, plots and page of one study. Return the files, the page last.

    Args:
        data: The study with all its episodes.
        loss: Largest loss of success, in points, that the verdict accepts.
        priced: The study's speeds on other machines, from `repriced`.
        publish: Write tables and plots into the results folder itself instead of its report/.

    Raises:
        Unpublishable: `publish` is set and the study may not be published.
        StorageError: The disk is full or read-only.
    """
    if publish:
        check_publishable(data)
    results, name = data.study.database.results, data.name
    folder, page = results if publish else results / "report", data.study.root / "report.html"
    tables, document = [], folder / "tables" / f"{name}.json"
    for suffix, table in tables_of(data, priced).items():
        tables.append(folder / "tables" / f"{name}{suffix}.csv")
        write_text(tables[-1], csv_text(table))
    write_json(document, further_of(data))
    pictures, title = [], data.study.title or data.study.name
    for suffix, figure in figures_of(data, loss).items():
        pictures.append(folder / "plots" / f"{name}{suffix}.png")
        write_bytes(pictures[-1], png(figure, title, about(data.results)))
    write_text(page, render(data, loss, priced, tables))
    return [*tables, document, *pictures, page]


def tables_of(data: StudyData, priced: Sequence[Priced]) -> dict[str, pd.DataFrame]:
    """Return the tables of a study's CSV files.

    Each key is the suffix of a file name: `_per_task` is the table for `<study>_per_task.csv`.
    """
    tables = {"": data.table[list(CSV_COLUMNS)], "_per_task": data.per_task[list(CSV_COLUMNS)]}
    if priced:
        tables["_on"] = prices_table(priced)
    if len(latencies := latency_table(data.results)):
        tables["_latency"] = latencies
    if is_stressed(data.results):
        tables["_summed"] = summed_table(data.results)
    return tables


class Unpublishable(KervError):
    """A study does not meet the conditions for publishing."""


def refusals(results: Sequence[Result]) -> list[str]:
    """Return the reasons why a study may not be published, as clauses of an error message. Empty if it may.

    Args:
        results: The study's rows over all tasks.
    """
    clauses = []
    values = {}
    for column in ("git_commit", "host", "device_name", "engine"):
        values[column] = split_values(row.provenance[column] for row in results)
    if any(commit.endswith("+changes") or commit in ("none", "") for commit in values["git_commit"]):
        clauses.append("some episodes were computed by code that is not committed")
    for found, what in zip(values.values(), ("commits", "machines", "devices", "engines"), strict=True):
        if len(found) > 1:
            clauses.append(f"its episodes are from {len(found)} {what}")
    compared = [row for row in results if row.is_compared]
    other_run = dict.fromkeys(row.label for row in compared if not row.measures.same_run)
    not_in_turn = dict.fromkeys(row.label for row in compared if row.measures.same_block < 1)
    for labels, what in ((other_run, "in one run with"), (not_in_turn, "in turn with")):
        if labels:
            clauses.append(f"not measured {what} the baseline: {', '.join(labels)}")
    return clauses


def check_publishable(data: StudyData) -> None:
    """Refuse to publish a study whose episodes are incomplete or for which `refusals` gives a reason.

    Raises:
        Unpublishable: The message lists all reasons.
    """
    clauses = [f"{len(data.absent)} of its episodes are missing"] if data.absent else []
    clauses += refusals(data.results)
    if clauses:
        raise Unpublishable(
            f"study {data.study.name} may not be published: {'; '.join(clauses)}. Commit, then run it on one "
            f"machine: 'kerv sweep study={data.study.name} results=fresh'"
        )
