"""Writes the tables, plots and page of each study from its stored episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_bytes, write_json, write_text
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import ROLLOUT, StudyStore, studies
from kerv_cli.report.latency import latency_table
from kerv_cli.report.page import render
from kerv_cli.report.plots import about, latency_figure, png, study_figures
from kerv_cli.report.publish import check_publishable
from kerv_cli.report.reprice import open_profiles, repriced_table
from kerv_cli.report.stressed import is_stressed, summed_table
from kerv_cli.report.tables import CSV_COLUMNS, StudyData, csv_text, further_of, load_study

LOSS = 3.0
"""Points of success that the page's verdict allows to lose by default."""


def names_to_report(results: Path | str, study: str | None) -> list[str]:
    """Return the name of the study; without one, the names of all studies that have an episode.

    Raises:
        UsageError: There is none.
    """
    present = [] if study else [one for one in studies(Database(results)) if one.kind != ROLLOUT and one.counts()[0]]
    names = [study] if study else sorted(store.name for store in present)
    if not names:
        raise UsageError(f"no study in {results} has an episode: run `kerv sweep study=demo`")
    return names


@dataclass
class Report:
    """Files and tables of a report.

    Attributes:
        files: In the order of writing.
        tables: Each study's table.
        priced: The `repriced_table` of the profiles in `on`.
    """

    files: list[Path]
    tables: dict[str, pd.DataFrame]
    priced: pd.DataFrame | None = None


def report(
    results: Path | str,
    study: str | None = None,
    publish: bool = False,
    on: Sequence[str] = (),
    loss: float = LOSS,
) -> Report:
    """Write a study's files, or those of every study that has an episode. The same episodes give the same bytes.

    The tables are <study>.csv, <study>_per_task.csv, <study>.json and with `on` <study>_on.csv.

    Args:
        results: Results folder.
        study: Name of the study; all if None.
        publish: Write tables and plots into the results folder itself instead of its report/.
        on: Names of profiles at which the study's decodes are priced.
        loss: Points of success that the verdict of studies/<study>/report.html allows to lose.

    Raises:
        UsageError: No such study, or nothing to report; the message names what to run.
        Unpublishable: A study that may not be published; nothing of it is written.
        CheckpointError: The database is damaged.
        StorageError: The disk is full or read-only.
    """
    if on and not study:
        raise UsageError(f"on={','.join(on)}: name the study whose decodes are to be priced, study=NAME")
    names = names_to_report(results, study)
    profiles, output = open_profiles(results, on), Report([], {})
    for name in names:
        store = StudyStore(results, name)
        data = load_study(store)
        output.priced = repriced_table(data, store, profiles) if profiles else None
        output.files += write_study(store, data, loss, publish, output.priced)
        output.tables[name] = data.table
    return output


def write_study(
    store: StudyStore, data: StudyData, loss: float, publish: bool = False, priced: pd.DataFrame | None = None
) -> list[Path]:
    """Write the tables, plots and page of one study and return its files, the page last.

    Args:
        store: The study's files.
        data: The whole study.
        loss: As in `report`.
        publish: As in `report`.
        priced: Its decodes at the costs of other machines, from `repriced_table`.

    Raises:
        Unpublishable, StorageError: As `report`.
    """
    results, name, title = store.database.results, store.name, data.study.title or store.name
    if publish:
        check_publishable(data)
    tables = {"": data.table[list(CSV_COLUMNS)], "_per_task": data.per_task[list(CSV_COLUMNS)]}
    figures = study_figures(data.table, data.study.axis, title)
    if priced is not None:
        tables["_on"] = priced
    latencies = latency_table(data.table)
    if len(latencies):
        tables["_latency"] = latencies
        heading = f"Success against the time that AR takes\n{about(data.table)}"
        figures["_latency"] = latency_figure(latencies, heading)
    if is_stressed(data.table):
        tables["_summed"] = summed_table(data.table)
    folder, page = results if publish else results / "report", store.root / "report.html"
    pictures = {folder / "plots" / f"{name}{suffix}.png": png(figure) for suffix, figure in figures.items()}
    texts = {folder / "tables" / f"{name}{suffix}.csv": csv_text(table) for suffix, table in tables.items()}
    for path, text in texts.items():
        write_text(path, text)
    document = folder / "tables" / f"{name}.json"
    write_json(document, further_of(data))
    for path, picture in pictures.items():
        write_bytes(path, picture)
    write_text(page, render(store, data, list(pictures.values()), list(texts), priced, loss))
    return [*texts, document, *pictures, page]
