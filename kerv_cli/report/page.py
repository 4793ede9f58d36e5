"""A study's HTML page: one file that loads nothing and links the recordings and tables beside it."""

from __future__ import annotations

import base64
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from kerv_cli.lab.store import StudyStore
from kerv_cli.report.decide import read_decisions, verdict_of
from kerv_cli.report.measures import MACRO, MICRO, Row
from kerv_cli.report.plots import about
from kerv_cli.report.reprice import ASSUMES, repriced_summary
from kerv_cli.report.summary import NOTE, SPEEDS, summary_frame
from kerv_cli.report.tables import StudyData, is_baseline, is_number, rows_of
from kerv_cli.report.verdict import caution


def render(
    store: StudyStore,
    data: StudyData,
    figures: Sequence[bytes],
    tables: Sequence[Path],
    priced: pd.DataFrame | None,
    loss: float,
) -> str:
    """Return the page.

    Args:
        store: The study's files and recordings.
        data: The study's episodes and tables.
        figures: PNG files.
        tables: The study's CSV files, which the page links.
        priced: The study's decodes at the costs of other machines, from `repriced_table`.
        loss: Points of success that the verdict allows to lose.
    """
    template = Environment(
        loader=PackageLoader("kerv_cli.report", "."), autoescape=True, undefined=StrictUndefined
    ).get_template("report.html.j2")
    answer, is_shown = verdict_of(data.table, loss)
    first, results = data.table.iloc[0], str(store.database.results)
    where = "" if results == "results" else f" results={shlex.quote(results)}"
    return template.render(
        name=store.name,
        title=data.study.title or store.name,
        verdict=answer[:1].upper() + answer[1:],
        is_shown=is_shown,
        caution=caution(data.table),
        note=data.study.note,
        about=f"{about(data.table)} · kerv {first['kerv_version']} at {str(first['git_commit'])[:12]}",
        columns=NOTE,
        baseline=data.study.baseline,
        absent=list(dict.fromkeys(f"{one.setting.label} on {one.task}" for one in data.absent)),
        missing=len(data.absent),
        planned=len(data.study.episodes),
        how_to_run=f"Run `kerv sweep study={store.name}{where}`",
        suite=_suite(data.table),
        decisions=read_decisions(store.root),
        figures=[base64.b64encode(figure).decode() for figure in figures],
        machines=None if priced is None else repriced_summary(priced),
        assumes=ASSUMES,
        tasks=_by_task(data.per_task),
        recordings=[(path.stem, _href(path, store.root)) for path in store.recordings],
        files=[(path.name, _href(path, store.root)) for path in tables],
        commands=[(setting.label, setting.overrides) for setting in data.study.settings],
    )


def _suite(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table of all settings, pooled over tasks; of several difficulties with their averages."""
    frame = summary_frame(table, MICRO)
    if table["difficulty"].str.contains(";").any():
        macro = summary_frame(table, MACRO)
        for name in ("success, %", *SPEEDS.values()):
            frame[f"{name}, by difficulty"] = macro.get(name, "–")
    return frame


def _by_task(per_task: pd.DataFrame) -> pd.DataFrame:
    """Return successes and speed per episode: tasks down, settings across, or the other way round if they are more."""
    cells = per_task.assign(text=[_cell(row) for row in rows_of(per_task)])
    table = cells.pivot(index="task", columns="label", values="text")[per_task["label"].unique()].fillna("–")
    return (table.T.rename_axis("setting") if len(table.columns) > len(table) else table).reset_index()


def _cell(row: Row) -> str:
    share = f"{int(row['successes'])}/{int(row['episodes'] // max(1, row['repeats']))}"
    if is_baseline(row) or not is_number(row["episode_speedup"]):
        return share
    return f"{share} · {row['episode_speedup']:.2f}×"


def _href(path: Path, folder: Path) -> str:
    """Return a file's address, relative to the folder of the page."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())
