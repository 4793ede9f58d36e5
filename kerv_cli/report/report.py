"""Writes the tables, plots and self-contained page of each study from its stored cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import atomic_path
from kerv_cli.lab.store import StudyStore, begun_studies
from kerv_cli.report import prediction
from kerv_cli.report.agreement import agreement_table
from kerv_cli.report.drawing import save_plot
from kerv_cli.report.latency import latency_figure, latency_summary, latency_table
from kerv_cli.report.measures import MICRO
from kerv_cli.report.page import Section, render
from kerv_cli.report.plots import about, study_figures
from kerv_cli.report.publish import check_publishable
from kerv_cli.report.reprice import ASSUMES, Machine, open_machines, repriced_summary, repriced_table
from kerv_cli.report.stressed import is_stressed, summed_table
from kerv_cli.report.tables import StudyData, load_study, per_task_table, study_table, write_csv
from kerv_cli.report.task_map import has_task_map, task_map


@dataclass
class Report:
    """Files and tables of a report. files: in the order of writing. tables: study -> its `study_table`. agreement: the
    `agreement_table` with another run of the study. priced: the `repriced_table` of the machines asked for."""

    files: list[Path]
    tables: dict[str, pd.DataFrame]
    agreement: pd.DataFrame | None = None
    priced: pd.DataFrame | None = None


def report(
    results: Path | str,
    study: str | None = None,
    publish: bool = False,
    against: str | None = None,
    on: Sequence[str] = (),
) -> Report:
    """Writes a study's files, or those of every study that has a complete cell and of every calibration.

    In report/, or to publish in the results folder itself: tables/<study>.csv and <study>_per_task.csv,
    plots/<study>*.png and, where small, .svg. Always studies/<study>/report.html. Tables and plots of
    prediction_<target> are added for a study whose methods predict actions; with `against`, the results folder of
    another run of the study, tables/<study>_agreement.csv; with `on`, names of profiles, tables/<study>_on.csv. The
    same cells give the same bytes.

    Raises:
        UsageError: no such study, or nothing to report; the message names what to run.
        Unpublishable: a study that may not be published; nothing of it is written.
        CheckpointError: a cell is damaged.
        StorageError: the disk refused.
    """
    reporter = _Reporter(Path(results), publish, open_machines(results, on))
    if study:
        reporter.report_study(study)
        if against is None:
            return reporter.report
        return replace(reporter.report, agreement=reporter.agreement(study, Path(against)))
    if against is not None:
        raise UsageError(f"against={against}: name the study of which it holds another run, study=NAME")
    if on:
        raise UsageError(f"on={','.join(on)}: name the study whose decodes are to be priced, study=NAME")
    names = begun_studies(results)
    calibrated = prediction.calibrated_targets(Path(results))
    if not names and not calibrated:
        raise UsageError(f"no study in {Path(results) / 'studies'} has a complete cell: run `kerv sweep study=demo`")
    for name in names:
        reporter.report_study(name)
    for target in calibrated:
        reporter.prediction_section(target)
    return reporter.report


class _Reporter:
    """Writes the files of studies; sections that several of them share are computed and written once."""

    def __init__(self, results: Path, publish: bool, machines: Sequence[Machine] = ()) -> None:
        self.results, self.publish, self.machines = results, publish, machines
        self.folder = results if publish else results / "report"
        self.report = Report([], {})
        self._sections: dict[str, Section | None] = {}

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
        settings = [cell.settings for cell in data.plan.cells]
        sections = [self.machines_section(priced), self.latency_section(data), self.stress_section(whole, name)]
        sections += [self.prediction_section(target) for target in prediction.predicting_targets(settings)]
        page = store.root / "report.html"
        files = self.report.files[before:]
        with atomic_path(page) as temporary:
            present = [section for section in sections if section is not None]
            temporary.write_text(render(store, data, whole, per_task, plots, present, files, priced), encoding="utf-8")
        self.report.files.append(page)

    def agreement(self, name: str, against: Path) -> pd.DataFrame:
        """Writes how far the study's run in another results folder agrees with the one reported here."""
        data = load_study(StudyStore(against, name))
        other = study_table(data)
        if self.publish:
            check_publishable(data, other)
        table = agreement_table(self.report.tables[name], other)
        self._save_table(table, f"{name}_agreement")
        return table

    def prediction_section(self, target: str) -> Section | None:
        """Writes a target's prediction errors; None where it was not calibrated."""
        if target not in self._sections:
            predictions = prediction.read_predictions(self.results, target)
            self._sections[target] = None if predictions is None else self._predictions(predictions)
        return self._sections[target]

    def _predictions(self, predictions: prediction.Predictions) -> Section:
        table = prediction.prediction_table(predictions)
        self._save_table(table, predictions.name)
        title = f"Prediction of the next actions, {predictions.target}"
        return Section(
            title=title,
            note=_prediction_note(predictions, table),
            figure=self._save_plot(prediction.prediction_figure(title, table), predictions.name),
            table=prediction.prediction_summary(table),
        )

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
            figure=self._save_plot(latency_figure(table, title, about), name),
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


def _prediction_note(predictions: prediction.Predictions, table: pd.DataFrame) -> str:
    return (
        "Mean absolute error on held-out demonstrations, mean over the tasks of "
        f"{', '.join(prediction.predicted_dofs(table))}, in normalised action units; "
        "brackets: share of the error of holding the last action. "
        f"Calibration {predictions.sha256[:12]}, predicted from the last {predictions.calibration.window} steps; "
        f"per task and DoF: tables/{predictions.name}.csv."
    )
