"""Writes the tables, plots and self-contained page of each study from its stored cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import atomic_path
from kerv_cli.lab.store import StudyStore, begun_studies
from kerv_cli.report.drawing import save_plot
from kerv_cli.report.latency import latency_summary, latency_table
from kerv_cli.report.measures import MICRO
from kerv_cli.report.page import LOSS, Section, render
from kerv_cli.report.plots import about, has_task_map, latency_figure, study_figures, task_map
from kerv_cli.report.publish import check_publishable
from kerv_cli.report.reprice import ASSUMES, Machine, open_machines, repriced_summary, repriced_table
from kerv_cli.report.stressed import is_stressed, summed_table
from kerv_cli.report.tables import StudyData, load_study, per_task_table, study_table, write_csv


@dataclass
class Report:
    """Files and tables of a report. files: in the order of writing. tables: study -> its `study_table`. priced: the
    `repriced_table` of the machines in `on`."""

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
    """Writes a study's files, or those of every study that has a complete cell.

    In report/, or to publish in the results folder itself: tables/<study>.csv and <study>_per_task.csv,
    plots/<study>*.png and, where small, .svg; with `on`, names of profiles, tables/<study>_on.csv. Always
    studies/<study>/report.html, whose verdict allows `loss` points of success. The same cells give the same bytes.

    Raises:
        UsageError: no such study, or nothing to report; the message names what to run.
        Unpublishable: a study that may not be published; nothing of it is written.
        CheckpointError: a cell is damaged.
        StorageError: the disk refused.
    """
    if on and not study:
        raise UsageError(f"on={','.join(on)}: name the study whose decodes are to be priced, study=NAME")
    names = [study] if study else begun_studies(results)
    if not names:
        raise UsageError(f"no study in {Path(results) / 'studies'} has a complete cell: run `kerv sweep study=demo`")
    reporter = _Reporter(Path(results), publish, open_machines(results, on), loss)
    for name in names:
        reporter.report_study(name)
    return reporter.report


class _Reporter:
    """Writes the files of studies."""

    def __init__(self, results: Path, publish: bool, machines: Sequence[Machine], loss: float) -> None:
        self.results, self.publish, self.machines, self.loss = results, publish, machines, loss
        self.folder = results if publish else results / "report"
        self.report = Report([], {})

    def report_study(self, name: str) -> None:
        """The files of one study; errors as `report`."""
        store = StudyStore(self.results, name)
        data = load_study(store)
        priced = repriced_table(data, self.machines) if self.machines else None
        whole, per_task = study_table(data), per_task_table(data)
        if self.publish:
            check_publishable(data, whole)
        self.report.tables[name] = whole
        before = len(self.report.files)
        self._save_table(whole, name)
        self._save_table(per_task, f"{name}_per_task")
        title = data.plan.title or name
        figures = study_figures(whole, data.plan.axis, title)
        if has_task_map(per_task):
            figures["_tasks"] = task_map(per_task, f"{title}: task by task", about(whole, "successes of each task"))
        plots = [self._save_plot(figure, f"{name}{suffix}") for suffix, figure in figures.items()]
        sections = [self.machines_section(priced), self.latency_section(data), self.stress_section(whole, name)]
        page = store.root / "report.html"
        files = self.report.files[before:]
        with atomic_path(page) as temporary:
            present = [section for section in sections if section is not None]
            text = render(store, data, whole, per_task, plots, present, files, priced, self.loss)
            temporary.write_text(text, encoding="utf-8")
        self.report.files.append(page)

    def machines_section(self, priced: pd.DataFrame | None) -> Section | None:
        """Writes the study's decodes at other machines' costs; None where none was asked for."""
        if priced is None:
            return None
        name = f"{priced['study'].iloc[0]}_on"
        self._save_table(priced, name)
        self.report.priced = priced
        return Section("On other machines", f"{ASSUMES}: tables/{name}.csv.", "", repriced_summary(priced))

    def latency_section(self, data: StudyData) -> Section | None:
        """Writes success at the latencies of a study whose world goes on; None where it waits."""
        table = latency_table(data)
        if table is None:
            return None
        name, title = f"{data.plan.name}_latency", "Success against the time that AR takes"
        self._save_table(table, name)
        about = f"{table['episodes'].max()} episodes per setting, {MICRO}"
        return Section(
            title=title,
            note=f"Every setting beside AR at the same latency and compensation, same episodes: tables/{name}.csv.",
            figure=self._save_plot(latency_figure(table, title, about), name) if table["ar_latency_ms"].any() else "",
            table=latency_summary(table),
        )

    def stress_section(self, whole: pd.DataFrame, study: str) -> Section | None:
        """Writes a study of stress summed over levels, kinds and all; None where nothing is stressed."""
        if not is_stressed(whole):
            return None
        table = summed_table(whole)
        name, title = f"{study}_summed", "Summed over levels, and over kinds"
        self._save_table(table, name)
        fields = table.drop(columns="label").rename(columns={"sum": "task", "method": "label"})
        figure = task_map(fields, title, about(whole, "successes over all tasks"))
        note = f"Points against the baseline under the same stresses, same episodes: tables/{name}.csv."
        return Section(title, note, self._save_plot(figure, name))

    def _save_table(self, table: pd.DataFrame, name: str) -> None:
        self.report.files.append(write_csv(table, self.folder / "tables" / f"{name}.csv"))

    def _save_plot(self, figure: Figure, name: str) -> str:
        """The figure's HTML element."""
        plot = save_plot(figure, self.folder / "plots", name)
        self.report.files.extend(plot.files)
        return plot.html
