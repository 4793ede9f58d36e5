"""Writes the tables, plots and self-contained page of each study from its stored episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_json, write_text
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import ROLLOUT, StudyStore, studies
from kerv_cli.report.drawing import save_plot
from kerv_cli.report.latency import latency_summary, latency_table
from kerv_cli.report.measures import MICRO
from kerv_cli.report.page import LOSS, Section, render
from kerv_cli.report.plots import about, has_task_map, latency_figure, study_figures, task_map
from kerv_cli.report.publish import check_publishable
from kerv_cli.report.reprice import ASSUMES, open_profiles, repriced_summary, repriced_table
from kerv_cli.report.stressed import is_stressed, summed_table
from kerv_cli.report.tables import CSV_COLUMNS, StudyData, further_of, load_study, write_csv


def names_to_report(results: Path | str, study: str | None) -> list[str]:
    """The study of that name; None: every study that has an episode. Raises UsageError: there is none."""
    there = [] if study else [one for one in studies(Database(results)) if one.kind != ROLLOUT and one.counts()[0]]
    names = [study] if study else sorted(store.name for store in there)
    if not names:
        raise UsageError(f"no study in {results} has an episode: run `kerv sweep study=demo`")
    return names


@dataclass
class Report:
    """Files and tables of a report. files: in the order of writing. tables: study -> its table. priced: the
    `repriced_table` of the profiles in `on`."""

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
    """Writes a study's files, or those of every study that has an episode.

    In report/, or to publish in the results folder itself: tables/<study>.csv, <study>_per_task.csv and <study>.json,
    plots/<study>*.png; with `on`, names of profiles, tables/<study>_on.csv. Always
    studies/<study>/report.html, whose verdict allows `loss` points of success. The same episodes give the same bytes.

    Raises:
        UsageError: no such study, or nothing to report; the message names what to run.
        Unpublishable: a study that may not be published; nothing of it is written.
        CheckpointError: the database is damaged.
        StorageError: the disk refused.
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
    """Writes the tables, plots and page of one study -> its files, the page last; errors as `report`.

    Args:
        data: of the whole study.
        priced: its decodes at the costs of other machines, `repriced_table`.
    """
    results = store.database.results
    if publish:
        check_publishable(data)
    files = _Files(results if publish else results / "report")
    files.add_table(data.table[list(CSV_COLUMNS)], store.name)
    files.add_table(data.per_task[list(CSV_COLUMNS)], f"{store.name}_per_task")
    files.add_json(further_of(data), store.name)
    title = data.study.title or store.name
    figures = study_figures(data.table, data.study.axis, title)
    if has_task_map(data.per_task):
        figures["_tasks"] = task_map(
            data.per_task, f"{title}: task by task", about(data.table, "successes of each task")
        )
    plots = [files.add_plot(figure, f"{store.name}{suffix}") for suffix, figure in figures.items()]
    sections = [_machines_section(priced, files), _latency_section(data, files), _stress_section(data, files)]
    page = store.root / "report.html"
    present = [section for section in sections if section is not None]
    write_text(page, render(store, data, plots, present, files.paths, loss))
    return [*files.paths, page]


class _Files:
    """The tables and plots of a study below a folder. paths: in the order of writing."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths: list[Path] = []

    def add_table(self, table: pd.DataFrame, name: str) -> None:
        """Writes tables/<name>.csv."""
        self.paths.append(write_csv(table, self.folder / "tables" / f"{name}.csv"))

    def add_json(self, value: Mapping[str, Any], name: str) -> None:
        """Writes tables/<name>.json."""
        self.paths.append(self.folder / "tables" / f"{name}.json")
        write_json(self.paths[-1], value)

    def add_plot(self, figure: Figure, name: str) -> str:
        """Writes plots/<name>.png -> the figure's HTML element."""
        self.paths.append(self.folder / "plots" / f"{name}.png")
        return save_plot(figure, self.paths[-1])


def _machines_section(priced: pd.DataFrame | None, files: _Files) -> Section | None:
    """The study's decodes at other machines' costs; None where no machine is named."""
    if priced is None:
        return None
    name = f"{priced['study'].iloc[0]}_on"
    files.add_table(priced, name)
    return Section("On other machines", f"{ASSUMES}: tables/{name}.csv.", "", repriced_summary(priced))


def _latency_section(data: StudyData, files: _Files) -> Section | None:
    """Success at the latencies of a study whose world goes on; None where it waits."""
    table = latency_table(data)
    if table is None:
        return None
    name, title = f"{data.study.name}_latency", "Success against the time that AR takes"
    files.add_table(table, name)
    subtitle = f"{table['episodes'].max()} episodes per setting, {MICRO}"
    return Section(
        title=title,
        note=f"Every setting beside AR at the same latency and compensation, same episodes: tables/{name}.csv.",
        figure=files.add_plot(latency_figure(table, title, subtitle), name) if table["ar_latency_ms"].any() else "",
        table=latency_summary(table),
    )


def _stress_section(data: StudyData, files: _Files) -> Section | None:
    """A study of stress summed over levels, kinds and all; None where nothing is stressed."""
    if not is_stressed(data.table):
        return None
    table = summed_table(data.table)
    name, title = f"{data.study.name}_summed", "Summed over levels, and over kinds"
    files.add_table(table, name)
    fields = table.drop(columns="label").rename(columns={"sum": "task", "method": "label"})
    figure = task_map(fields, title, about(data.table, "successes over all tasks"))
    note = f"Points against the baseline under the same stresses, same episodes: tables/{name}.csv."
    return Section(title, note, files.add_plot(figure, name))
