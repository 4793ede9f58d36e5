"""Write the tables, plots and web page of each study, from its stored episodes."""

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
from kerv_cli.report.summary import NOTE, SPEEDS, of_runs, summary_frame
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
"""Default for the largest loss of success that the page's verdict accepts, in points."""


def names_to_report(results: Path | str, study: str | None) -> list[str]:
    """Return the names of the studies to report.

    Args:
        results: Results folder.
        study: Name of one study. None: every study that has at least one episode.

    Raises:
        UsageError: No study has an episode.
    """
    present = [] if study else [one for one in studies(Database(results)) if one.kind != ROLLOUT and one.counts()[0]]
    names = [study] if study else sorted(store.name for store in present)
    if not names:
        raise UsageError(f"no study in {results} has an episode: run `kerv sweep study=demo`")
    return names


@dataclass
class Report:
    """What `report` wrote and computed.

    Attributes:
        files: Written files, in the order of writing.
        tables: Name of each study -> its table.
        priced: The study's speeds on other machines, from `repriced_table`. None if `on` was empty.
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
    """Write the tables, plots and page of one study, or of every study that has an episode.

    The tables are <study>.csv, <study>_per_task.csv, <study>.json and, with `on`, <study>_on.csv. The same episodes
    give the same bytes.

    Args:
        results: Results folder.
        study: Name of the study. None: all studies.
        publish: Write tables and plots into the results folder itself instead of its report/. Refused for studies that
            do not meet the conditions for publishing.
        on: Names of cost profiles of other machines. The study's speeds on each are estimated (docs/measuring.md).
        loss: Largest loss of success, in points, that the verdict on the page accepts.

    Raises:
        UsageError: There is no such study, or nothing to report. The message names what to run.
        Unpublishable: The study may not be published. None of its files is written.
        CheckpointError: The database is damaged.
        StorageError: The disk is full or read-only.
    """
    if on and not study:
        raise UsageError(f"on={','.join(on)}: name the study to price with study=NAME")
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
    """Write the tables, plots and page of one study. Return the files, the page last.

    Args:
        store: The study's files.
        data: The study with all its episodes.
        loss: Largest loss of success, in points, that the verdict accepts.
        publish: Write tables and plots into the results folder itself instead of its report/.
        priced: The study's speeds on other machines, from `repriced_table`. None: leave them out.

    Raises:
        Unpublishable: `publish` is set and the study may not be published.
        StorageError: The disk is full or read-only.
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
    """Return the study's page as HTML.

    Args:
        store: The study's files and recordings.
        data: The study's episodes and tables.
        figures: Plots as PNG files, which are embedded.
        tables: CSV files of the study, which are linked.
        priced: The study's speeds on other machines, from `repriced_table`. None: leave them out.
        loss: Largest loss of success, in points, that the verdict accepts.
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
        columns=f"{NOTE} {of_runs(data.table)}",
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
    """Return the page's table of settings, pooled over tasks.

    If the tasks have several difficulty groups, add columns with the unweighted mean of the groups.
    """
    frame = summary_frame(table, MICRO)
    if table["difficulty"].str.contains(";").any():
        macro = summary_frame(table, MACRO)
        for name in ("success, %", *SPEEDS.values()):
            frame[f"{name}, by difficulty"] = macro.get(name, "–")
    return frame


def _by_task(per_task: pd.DataFrame) -> pd.DataFrame:
    """Return the page's table of successes and speeds per episode, by task and setting.

    Tasks are rows and settings are columns, unless there are more settings than tasks.
    """
    cells = per_task.assign(text=[_cell(row) for row in rows_of(per_task)])
    table = cells.pivot(index="task", columns="label", values="text")[per_task["label"].unique()].fillna("–")
    return (table.T.rename_axis("setting") if len(table.columns) > len(table) else table).reset_index()


def _cell(row: Row) -> str:
    """Return successes / episodes and, if measured, the speed per episode, as text."""
    share = f"{int(row['successes'])}/{int(row['episodes'] // max(1, row['repeats']))}"
    if is_baseline(row) or not is_number(row["episode_speedup"]):
        return share
    return f"{share} · {row['episode_speedup']:.2f}×"


def _href(path: Path, folder: Path) -> str:
    """Return the address of a file relative to the page's folder."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())


class Unpublishable(KervError):
    """A study does not meet the conditions for publishing."""


def refusals(table: pd.DataFrame) -> list[str]:
    """Return the reasons why a study's table may not be published, as clauses of an error message. Empty if it may."""
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
    """Refuse to publish a study whose episodes are incomplete or for which `refusals` gives a reason.

    Raises:
        Unpublishable: The message lists all reasons.
    """
    clauses = [f"{len(data.absent)} of its episodes are missing"] if data.absent else []
    clauses += refusals(data.table)
    if clauses:
        raise Unpublishable(
            f"study {data.study.name} may not be published: {'; '.join(clauses)}. Commit, then run 'kerv sweep "
            f"study={data.study.name}' into a fresh results folder on one machine"
        )
