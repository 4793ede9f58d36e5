"""A study's HTML page: one file; nothing is loaded from elsewhere but the recordings and tables beside it."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from kerv_cli.lab.store import StudyStore
from kerv_cli.report import stressed
from kerv_cli.report.decide import choices, read_verdicts, sentence
from kerv_cli.report.measures import MACRO, MICRO, Row
from kerv_cli.report.summary import SPEEDS, differences, summary_frame
from kerv_cli.report.tables import StudyData, is_baseline, is_number, rows_of

LOSS = 3.0
"""Points of success that the page's verdict allows to lose by default."""


@dataclass(frozen=True)
class Section:
    """An extra section of the page: prediction errors, latency, stress."""

    title: str
    note: str
    figure: str  # an HTML element
    table: pd.DataFrame | None = None  # of text


def render(
    store: StudyStore,
    data: StudyData,
    figures: Sequence[str],
    sections: Sequence[Section],
    files: Sequence[Path],
    loss: float,
) -> str:
    """The page.

    Args:
        figures: HTML elements.
        files: the study's tables and plots; the page links the tables.
        loss: points of success that the verdict allows.
    """
    template = Environment(
        loader=PackageLoader("kerv_cli.report", "."), autoescape=True, undefined=StrictUndefined
    ).get_template("report.html.j2")
    decisions = read_verdicts(store.root)
    answer, is_shown = verdict(data.table, loss)
    return template.render(
        name=store.name,
        title=data.study.title or store.name,
        verdict=answer[:1].upper() + answer[1:],
        is_shown=is_shown,
        caution=caution(data.table),
        note=data.study.note,
        about=_about(data.table),
        baseline=data.study.baseline,
        absent=list(dict.fromkeys(f"{one.setting.label} on {one.task}" for one in data.absent)),
        missing=len(data.absent),
        planned=len(data.study.wanted),
        how_to_run=_how_to_run(store),
        suite=_suite(data.table),
        reasons=differences(rows_of(data.table, MICRO)),
        decisions=[] if decisions is None else rows_of(decisions),
        figures=figures,
        sections=sections,
        tasks=_by_task(data.per_task),
        recordings=[(path.stem, _href(path, store.root)) for path in store.recordings],
        files=[(path.name, _href(path, store.root)) for path in files if path.suffix == ".csv"],
        commands=[(setting.label, setting.overrides) for setting in data.study.settings],
    )


def verdict(whole: pd.DataFrame, loss: float) -> tuple[str, bool]:
    """The study's answer in one sentence, and whether it names a setting that is shown to be faster at that loss of
    success, in points. whole: a study's table."""
    if stressed.is_stressed(whole):
        return stressed.verdict(whole), False
    rows = rows_of(whole, MICRO)
    if not any(row["pairs"] and not is_baseline(row) for row in rows):
        rates = ", ".join(f"{row['label']} {100 * row['success']:.1f} %" for row in rows)
        return f"success: {rates}.", False
    choice = choices(whole, None, loss)[0]
    return f"{sentence(choice, loss, str(whole['baseline'].iloc[0]))}.", bool(choice.chosen)


def caution(whole: pd.DataFrame) -> str:
    """Warnings that stand before the numbers, in one line; empty where there is none."""
    rows = rows_of(whole, MICRO)
    privileged = sorted({str(row["target"]) for row in rows if "privileged" in str(row["observation"])})
    clauses = []
    if privileged:
        clauses.append(f"{', '.join(privileged)}: privileged, it is given object and goal positions")
    unverified = [
        str(row["label"]) for row in rows if is_number(row["unverified_share"]) and row["unverified_share"] == 1
    ]
    if unverified:
        clauses.append(f"{', '.join(unverified)}: nothing is verified")
    return "; ".join(clauses)


def _about(whole: pd.DataFrame) -> str:
    first = whole.iloc[0]
    return ", ".join(
        [
            f"policy {', '.join(whole['target'].unique())}",
            f"{whole['tasks'].max()} tasks",
            f"{whole['episodes'].max()} episodes per setting",
            str(first["device_name"]),
            f"{first['dtype']}, {first['threads']} threads, {first['workers']} processes",
            f"torch {first['torch_version']}",
            f"kerv {first['kerv_version']} at {str(first['git_commit'])[:12]}",
        ]
    )


def _suite(whole: pd.DataFrame) -> pd.DataFrame:
    """The table of all settings, pooled over tasks, with the numbers that the average over difficulty changes."""
    frame = summary_frame(whole, MICRO)
    if MACRO not in set(whole["averaging"]) or whole["difficulty"].astype(str).str.count(";").max() == 0:
        return frame
    macro = summary_frame(whole, MACRO)
    for name in ("success %", *SPEEDS.values()):
        frame[f"{name}, by difficulty"] = macro[name]
    return frame


def _how_to_run(store: StudyStore) -> str:
    """The command that completes the study, wherever its results lie."""
    results = str(store.database.results)
    where = "" if results == "results" else f" results={shlex.quote(results)}"
    return f"Run `kerv sweep study={store.name}{where}`"


def _by_task(per_task: pd.DataFrame) -> pd.DataFrame:
    """A row per task, a column per setting: successes and speeds, per episode and per step. A study of stress has
    many settings: they are the rows there, and the tasks the columns."""
    cells = per_task.assign(text=[_cell(row) for row in rows_of(per_task)])
    table = cells.pivot(index="task", columns="label", values="text")[per_task["label"].unique()].fillna("–")
    return (table.T.rename_axis("setting") if stressed.is_stressed(per_task) else table).reset_index()


def _cell(row: Row) -> str:
    share = f"{int(row['successes'])}/{int(row['episodes'] // max(1, row['repeats']))}"
    if is_baseline(row) or not is_number(row["speedup"]):
        return share
    return f"{share} · {row['episode_speedup']:.2f}×, {row['speedup']:.2f}×"


def _href(path: Path, folder: Path) -> str:
    """A file's address, relative to the folder of the page."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())
