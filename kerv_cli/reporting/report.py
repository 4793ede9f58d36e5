"""Tables, plots and one self-contained page per study, regenerated from its cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from kerv_cli.errors import UsageError
from kerv_cli.files import atomic_path
from kerv_cli.reporting.curvature import radius_figure, radius_table
from kerv_cli.reporting.drawing import save_figure
from kerv_cli.reporting.measures import MACRO, MICRO
from kerv_cli.reporting.plots import study_figures
from kerv_cli.reporting.prediction import (
    Predictions,
    calibrated_targets,
    predicting_targets,
    prediction_figure,
    prediction_summary,
    prediction_table,
    read_predictions,
)
from kerv_cli.reporting.summary import summary_frame
from kerv_cli.reporting.tables import StudyData, load_study, per_task_table, study_table, write_csv
from kerv_cli.studies.store import StudyStore, list_studies


def report(results: Path | str, study: str | None = None) -> list[Path]:
    """Writes a study's files, or those of every study that has a complete cell and of every calibration.

    results/tables/<study>.csv and <study>_per_task.csv, results/plots/<study>*.png and .svg,
    results/studies/<study>/report.html; where a study's methods predict actions, prediction_<target>, where they
    choose by curvature, boundary_radius among the tables and plots. The same cells give the same bytes.

    Returns:
        The files written.

    Raises:
        UsageError: no such study, or nothing to report; the message names what to run.
        CheckpointError: a cell is damaged.
        StorageError: the disk refused.
    """
    results = Path(results)
    if study:
        return report_study(results, study)
    names = [s.name for s in list_studies(results) if s.complete]
    calibrated = calibrated_targets(results)
    if not names and not calibrated:
        raise UsageError(f"no study in {results / 'studies'} has a complete cell: run `kerv sweep study=NAME`")
    written = [path for name in names for path in report_study(results, name)]
    for target in calibrated:
        written += _report_prediction(results, target).files
    return list(dict.fromkeys([*written, *_report_curvature(results).files]))


@dataclass(frozen=True)
class Section:
    """A part of the page that is not about the study's own cells; without a title: nothing to show."""

    title: str = ""
    note: str = ""
    figure: str = ""  # SVG
    table: pd.DataFrame | None = None  # texts
    files: tuple[Path, ...] = ()


def report_study(results: Path, name: str) -> list[Path]:
    """The files of one study; errors as `report`."""
    store = StudyStore(results, name)
    data = load_study(store)
    whole, per_task = study_table(data), per_task_table(data)
    written = [
        write_csv(whole, results / "tables" / f"{name}.csv"),
        write_csv(per_task, results / "tables" / f"{name}_per_task.csv"),
    ]
    figures = study_figures(whole, data.plan.axis, data.plan.title or name)
    for suffix, figure in figures.items():
        written += [save_figure(figure, results / "plots" / f"{name}{suffix}.{kind}") for kind in ("png", "svg")]
    vectors = [_inline(results / "plots" / f"{name}{suffix}.svg", f"f{i}-") for i, suffix in enumerate(figures)]
    settings = [cell.settings for cell in data.plan.cells]
    sections = [_report_prediction(results, target) for target in predicting_targets(settings)]
    if _varies_boundary(settings):
        sections.append(_report_curvature(results))
    written += [path for section in sections for path in section.files]
    page = store.root / "report.html"
    with atomic_path(page) as temporary:
        temporary.write_text(_page(store, data, whole, per_task, vectors, sections), encoding="utf-8")
    return [*written, page]


def _report_prediction(results: Path, target: str) -> Section:
    """Writes a target's prediction errors; nothing where it was not calibrated."""
    predictions = read_predictions(results, target)
    if predictions is None:
        return Section()
    table = prediction_table(predictions)
    files = _save(results, predictions.name, table, prediction_figure(predictions, table))
    return Section(
        title=f"Prediction of the next actions, {target}",
        note=_prediction_note(predictions),
        figure=_inline(files[-1], f"{predictions.name}-"),
        table=prediction_summary(table),
        files=files,
    )


def _prediction_note(predictions: Predictions) -> str:
    return (
        "Mean absolute error on held-out demonstrations, mean of dx, dy, dz over the tasks, in normalised action "
        "units; brackets: share of the error of holding the last action. "
        f"Calibration {predictions.sha256[:12]}, predicted from the last {predictions.window} steps; "
        f"per task and DoF: tables/{predictions.name}.csv."
    )


def _report_curvature(results: Path) -> Section:
    """Writes what the boundary's radius and the public code's measure on known paths."""
    table = radius_table()
    files = _save(results, "boundary_radius", table, radius_figure(table))
    return Section(
        title="Radius of curvature",
        note="Synthetic arcs and lines. The public code's “radius” is a constant times the speed.",
        figure=_inline(files[-1], "radius-"),
        files=files,
    )


def _varies_boundary(settings: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the study compares boundaries; `always` is the absence of one."""
    boundaries = [s.get("boundary") or {"kind": "always"} for s in settings]
    return len({str(b) for b in boundaries if b["kind"] != "always"}) > 1


def _save(results: Path, name: str, table: pd.DataFrame, figure: Figure) -> tuple[Path, ...]:
    """The table's CSV, the figure's PNG and SVG."""
    plots = [save_figure(figure, results / "plots" / f"{name}.{kind}") for kind in ("png", "svg")]
    return (write_csv(table, results / "tables" / f"{name}.csv"), *plots)


def _page(
    store: StudyStore,
    data: StudyData,
    whole: pd.DataFrame,
    per_task: pd.DataFrame,
    figures: list[str],
    sections: Sequence[Section],
) -> str:
    first = whole.iloc[0]
    about = ", ".join(
        [
            f"{whole['tasks'].max()} tasks",
            f"{whole['episodes'].max()} episodes per setting",
            str(first["device_name"]),
            f"{first['dtype']}, {first['threads']} threads, {first['workers']} processes",
            f"torch {first['torch_version']}",
            f"kerv {first['kerv_version']} at {str(first['git_commit'])[:12]}",
        ]
    )
    by_task = summary_frame(per_task, "one task")
    by_task.insert(0, "task", list(per_task["task"]))
    template = Environment(
        loader=PackageLoader("kerv_cli.reporting", "."), autoescape=True, undefined=StrictUndefined
    ).get_template("report.html.j2")
    return template.render(
        name=store.name,
        title=data.plan.title or store.name,
        about=about,
        baseline=data.plan.baseline,
        absent=[f"{cell.label} on {cell.task}" for cell in data.absent],
        planned=len({cell.id for cell in data.plan.cells}),
        how_to_run=store.how_to_run().capitalize(),
        summaries={averaging: summary_frame(whole, averaging) for averaging in (MICRO, MACRO)},
        figures=figures,
        sections=[section for section in sections if section.title],
        per_task=by_task,
        everything=_as_texts(whole),
    )


def _as_texts(table: pd.DataFrame) -> pd.DataFrame:
    """Values as the CSV file writes them."""
    return pd.DataFrame(
        {name: [f"{v:.6g}" if isinstance(v, float) else "" if v is None else v for v in table[name]] for name in table}
    ).replace("nan", "")


def _inline(svg: Path, prefix: str) -> str:
    """The <svg> element alone, its ids made unique: two figures in one page must not share clip paths."""
    text = svg.read_text(encoding="utf-8")
    text = text[text.index("<svg") :]
    for before in ('id="', 'xlink:href="#', "url(#"):
        text = text.replace(before, before + prefix)
    return text
