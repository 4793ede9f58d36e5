"""Tables, plots and one self-contained page per study, regenerated from its cells."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from kerv_cli.errors import UsageError
from kerv_cli.files import atomic_path
from kerv_cli.studies.measures import MACRO, MICRO
from kerv_cli.studies.plots import figure_bytes, save_figure, study_figures
from kerv_cli.studies.store import StudyStore, list_studies
from kerv_cli.studies.summary import summary_frame
from kerv_cli.studies.tables import StudyData, load_study, per_task_table, study_table, write_csv


def report(results: Path | str, study: str | None = None) -> list[Path]:
    """Writes a study's files, or those of every study that has a complete cell.

    results/tables/<study>.csv and <study>_per_task.csv, results/plots/<study>*.png and .svg,
    results/studies/<study>/report.html. The same cells give the same bytes.

    Returns:
        The files written.

    Raises:
        UsageError: no such study, or nothing to report; the message names what to run.
        CheckpointError: a cell is damaged.
        StorageError: the disk refused.
    """
    results = Path(results)
    names = [study] if study else [s.name for s in list_studies(results) if s.complete]
    if not names:
        raise UsageError(f"no study in {results / 'studies'} has a complete cell: run `kerv sweep study=NAME`")
    return [path for name in names for path in report_study(results, name)]


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
    vectors = [_inline(figure_bytes(figure, "svg"), f"f{i}-") for i, figure in enumerate(figures.values())]
    page = store.root / "report.html"
    with atomic_path(page) as temporary:
        temporary.write_text(_page(store, data, whole, per_task, vectors), encoding="utf-8")
    return [*written, page]


def _page(store: StudyStore, data: StudyData, whole: pd.DataFrame, per_task: pd.DataFrame, figures: list[str]) -> str:
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
        loader=PackageLoader("kerv_cli.studies", "."), autoescape=True, undefined=StrictUndefined
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
        per_task=by_task,
        everything=_as_texts(whole),
    )


def _as_texts(table: pd.DataFrame) -> pd.DataFrame:
    """Values as the CSV file writes them."""
    return pd.DataFrame(
        {name: [f"{v:.6g}" if isinstance(v, float) else "" if v is None else v for v in table[name]] for name in table}
    ).replace("nan", "")


def _inline(svg: bytes, prefix: str) -> str:
    """The <svg> element alone, its ids made unique: two figures in one page must not share clip paths."""
    text = svg.decode("utf-8")
    text = text[text.index("<svg") :]
    for before in ('id="', 'xlink:href="#', "url(#"):
        text = text.replace(before, before + prefix)
    return text
