"""Writes the tables, plots and page of each study from its stored episodes."""

from __future__ import annotations

import base64
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.files import write_bytes, write_json, write_text
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import ROLLOUT, StudyStore, studies
from kerv_cli.report.decide import read_decisions, verdict_of
from kerv_cli.report.measures import MACRO, MICRO, Row
from kerv_cli.report.plots import about, latency_figure, png, study_figures
from kerv_cli.report.reprice import ASSUMES, open_profiles, repriced_summary, repriced_table
from kerv_cli.report.stressed import is_stressed, summed_table
from kerv_cli.report.summary import NOTE, SPEEDS, summary_frame
from kerv_cli.report.tables import (
    CSV_COLUMNS,
    StudyData,
    csv_text,
    further_of,
    is_baseline,
    is_number,
    latency_table,
    load_study,
    rows_of,
    values_of,
)
from kerv_cli.report.verdict import caution

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
        store=store,
        study=data.study,
        title=data.study.title or store.name,
        verdict=answer[:1].upper() + answer[1:],
        is_shown=is_shown,
        caution=caution(data.table),
        about=f"{about(data.table)} · kerv {first['kerv_version']} at {str(first['git_commit'])[:12]}",
        columns=NOTE,
        absent=list(dict.fromkeys(f"{one.setting.label} on {one.task}" for one in data.absent)),
        missing=len(data.absent),
        where=where,
        suite=_suite(data.table),
        decisions=read_decisions(store.root),
        figures=[base64.b64encode(figure).decode() for figure in figures],
        machines=None if priced is None else repriced_summary(priced),
        assumes=ASSUMES,
        tasks=_by_task(data.per_task),
        recordings=[(path.stem, _href(path, store.root)) for path in store.recordings],
        files=[(path.name, _href(path, store.root)) for path in tables],
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


class Unpublishable(KervError):
    """A study whose table does not meet the conditions for publishing."""


def refusals(table: pd.DataFrame) -> list[str]:
    """Return why a study's table may not be published, a clause each; empty if it may."""
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
    """Refuse a study that lacks episodes or has `refusals`.

    Raises:
        Unpublishable: The line lists all reasons.
    """
    clauses = [f"{len(data.absent)} of its episodes are missing"] if data.absent else []
    clauses += refusals(data.table)
    if clauses:
        raise Unpublishable(
            f"study {data.study.name} may not be published: {'; '.join(clauses)}. Commit, then run 'kerv sweep "
            f"study={data.study.name}' into a fresh results folder on one machine"
        )
