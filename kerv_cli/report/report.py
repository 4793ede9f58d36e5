"""Write the tables, plots and web page of each study, from its stored episodes.

A page has a verdict, tables, charts and settings. templates/_study.html is its body.
"""

from __future__ import annotations

import base64
import functools
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import altair as alt
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from kerv_cli.base.errors import KervError, UsageError, has_rerun
from kerv_cli.base.files import write_bytes, write_json, write_text
from kerv_cli.episodes.identity import NOT_DETERMINING, without
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import ROLLOUT, SWEEP, Study, studies
from kerv_cli.report.glossary import explanations, with_code
from kerv_cli.report.plots import about, acceptance_figure, latency_figure, library, png, study_figures
from kerv_cli.report.profiles import NamedProfile, open_profiles
from kerv_cli.report.reprice import ASSUMES, Priced, own_prices, prices_table, repriced, repriced_summary
from kerv_cli.report.results import MACRO, Result, csv_text, is_number
from kerv_cli.report.summary import MAIN, MISSING, NOTE, SPEEDS, of_runs, summary_frame
from kerv_cli.report.tables import (
    CSV_COLUMNS,
    StudyData,
    differences,
    flatten,
    further_of,
    is_stressed,
    load_study,
    split_values,
    summed_table,
)
from kerv_cli.report.verdict import Verdict, caution, order_of, question, verdict_of
from kerv_cli.report.viewing.film import animation, film_of

LOSS = 3.0
"""Default for the largest loss of success that the page's verdict accepts, in points."""
_FRAMES = 240
"""Films play at half speed. A film with more than half this number of frames plays faster, to stay short and small."""


def to_report(database: Database, study: str | None) -> list[Study]:
    """Return the studies to report.

    Args:
        database: The database.
        study: Name of one study. None: every study that has at least one episode, sorted by name.

    Raises:
        UsageError: No study has an episode.
    """
    if study:
        return [Study(database, study)]
    stores = [one for one in studies(database) if one.kind != ROLLOUT and one.counts()[0]]
    if not stores:
        raise UsageError(f"no study in {database.results} has an episode: run `kerv sweep study=demo`")
    return sorted(stores, key=lambda one: one.name)


@dataclass(frozen=True)
class Report:
    """A report on one study: its verdict, charts and written files. Verdict and charts are computed once.

    Attributes:
        data: The study with its tables.
        loss: Largest loss of success, in points, that the verdict accepts.
        priced: The study's speeds on other machines. Empty: none were estimated.
        files: Written files, in the order of writing, the page last. Empty: nothing was written.
    """

    data: StudyData
    loss: float = LOSS
    priced: Sequence[Priced] = ()
    files: list[Path] = field(default_factory=list)

    @functools.cached_property
    def verdict(self) -> Verdict:
        """The study's answer."""
        return verdict_of(self.data.results, self.loss)

    @property
    def command_to_settle(self) -> str:
        """The command that runs enough episodes for the verdict to name a setting.

        Empty if the verdict names one already, if more episodes would not help, or if the study is not a sweep.
        """
        study, episodes = self.data.study, self.verdict.episodes
        return study.sweep_command(f"episodes={episodes}") if study.kind == SWEEP and episodes else ""

    @functools.cached_property
    def figures(self) -> dict[str, alt.ConcatChart]:
        """The study's charts.

        Each key is the suffix of a file name: `_latency` is the chart for `<study>_latency.png`.
        """
        data = self.data
        figures = study_figures(data.results, data.study.axis, self.loss)
        if len(data.latencies):
            figures["_latency"] = latency_figure(data.results, data.latencies)
        if data.tallies:
            figures["_acceptance"] = acceptance_figure(data.tallies, data.references)
        return figures


def report(
    database: Database,
    study: str | None = None,
    publish: bool = False,
    on: Sequence[str] = (),
    loss: float = LOSS,
    baseline: str = "",
) -> list[Report]:
    """Write the tables, plots and page of one study, or of every study that has an episode. Return a report of each.

    The tables are <study>.csv, <study>_per_task.csv, <study>.json and, with `on`, <study>_on.csv. The same episodes
    give the same bytes.

    Args:
        database: The database. Files are written to its results folder.
        study: Name of the study. None: all studies.
        publish: Write tables and plots into the results folder itself instead of its report/. Refused for studies that
            do not meet the conditions for publishing.
        on: Names of cost profiles of other machines. The study's speeds on each are estimated (docs/measuring.md).
        loss: Largest loss of success, in points, that the verdict on the page accepts.
        baseline: Label of the setting to compare with, in place of the study's baseline.

    Raises:
        UsageError: There is no such study or setting, or nothing to report. The message names what to run.
        Unpublishable: The study may not be published. None of its files is written.
        CheckpointError: The database is damaged.
        StorageError: The disk is full or read-only.
    """
    if (on or baseline) and not study:
        given = f"on={','.join(on)}" if on else f"baseline={baseline}"
        raise UsageError(f"{given}: name the study with study=NAME")
    profiles, reports = open_profiles(database.results, on), []
    for store in to_report(database, study):
        data = load_study(store)
        if baseline:
            data = data.compared_with(baseline)
        reports.append(write_study(data, loss, profiles, publish))
    return reports


def write_study(data: StudyData, loss: float, profiles: Sequence[NamedProfile] = (), publish: bool = False) -> Report:
    """Write the tables, plots and page of one study.

    Args:
        data: The study with all its episodes.
        loss: Largest loss of success, in points, that the verdict accepts.
        profiles: Cost profiles of the machines for which speeds are estimated. Empty: the profiles that the study's
            file names, and measured profiles of the machine that ran the study.
        publish: Write tables and plots into the results folder itself instead of its report/.

    Raises:
        Unpublishable: `publish` is set, and episodes are missing or `refusals` gives a reason. All reasons are named.
        StorageError: The disk is full or read-only.
    """
    priced = repriced(data, profiles) if profiles else own_prices(data)
    if publish:
        clauses = [f"{len(data.absent)} of its episodes are missing"] if data.absent else []
        clauses += refusals(data.results)
        if clauses:
            raise Unpublishable(
                f"study {data.study.name} may not be published: {'; '.join(clauses)}. Commit, then run it on one "
                f"machine: 'kerv sweep study={data.study.name} results=fresh'"
            )
    report, name = Report(data, loss, priced), data.name
    folder = data.study.database.results if publish else data.study.database.results / "report"
    for suffix, table in tables_of(data, priced).items():
        report.files.append(folder / "tables" / f"{name}{suffix}.csv")
        write_text(report.files[-1], csv_text(table))
    report.files.append(folder / "tables" / f"{name}.json")
    write_json(report.files[-1], further_of(data))
    for suffix, figure in report.figures.items():
        report.files.append(folder / "plots" / f"{name}{suffix}.png")
        write_bytes(report.files[-1], png(figure, data.study.title or data.study.name, about(data.results)))
    page = render(report)
    report.files.append(data.study.root / "report.html")
    write_text(report.files[-1], page)
    return report


def tables_of(data: StudyData, priced: Sequence[Priced]) -> dict[str, pd.DataFrame]:
    """Return the tables of a study's CSV files.

    Each key is the suffix of a file name: `_per_task` is the table for `<study>_per_task.csv`.
    """
    tables = {"": data.table[list(CSV_COLUMNS)], "_per_task": data.per_task[list(CSV_COLUMNS)]}
    if priced:
        tables["_on"] = prices_table(priced)
    if len(data.latencies):
        tables["_latency"] = data.latencies
    if is_stressed(data.results):
        tables["_summed"] = summed_table(data.results)
    return tables


class Unpublishable(KervError):
    """A study does not meet the conditions for publishing."""


def refusals(results: Sequence[Result]) -> list[str]:
    """Return the reasons why a study may not be published, as clauses of an error message. Empty: it may be published.

    Args:
        results: The study's rows over all tasks.
    """
    clauses = []
    values = {}
    for column in ("git_commit", "host", "device_name", "engine"):
        values[column] = split_values(row.provenance[column] for row in results)
    if any(commit.endswith("+changes") or commit in ("none", "") for commit in values["git_commit"]):
        clauses.append("some episodes were computed by code that is not committed")
    for found, what in zip(values.values(), ("commits", "machines", "devices", "engines"), strict=True):
        if len(found) > 1:
            clauses.append(f"its episodes are from {len(found)} {what}")
    compared = [row for row in results if row.is_compared]
    other_run = dict.fromkeys(row.label for row in compared if not row.measures.same_run)
    not_in_turn = dict.fromkeys(row.label for row in compared if row.measures.same_block < 1)
    for labels, what in ((other_run, "in one run with"), (not_in_turn, "in turn with")):
        if labels:
            clauses.append(f"not measured {what} the baseline: {', '.join(labels)}")
    return clauses


def render(report: Report) -> str:
    """Return the study's page as one HTML file that needs no other file and no network."""
    loader = PackageLoader("kerv_cli.report", "templates")
    templates = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    templates.filters["code"] = with_code
    template = templates.get_template("study.html")
    values = study_parts(report) | {"films": _films(report.data)}
    return template.render(**values, library=library())


def study_parts(report: Report) -> dict[str, Any]:
    """Return the values that the template _study.html shows."""
    data, verdict = report.data, report.verdict
    study, rows = data.study, data.results
    first, results, answer = rows[0].provenance, str(study.database.results), verdict.sentence
    if not answer.startswith(tuple(row.label for row in rows)):  # a label stays as it is
        answer = answer[:1].upper() + answer[1:]
    return {
        "name": study.name,
        "title": data.study.title or study.name,
        "note": data.study.note,
        "about": f"{about(rows)} · kerv {first['kerv_version']} at {first['git_commit'][:12]}",
        "question": question(rows, report.loss),
        "verdict": answer,
        "is_shown": verdict.is_shown,
        "order": order_of(data.by_speed),
        "settles": report.command_to_settle,
        "caution": caution(rows),
        "wanted": len(data.study.episodes),
        "missing": len(data.absent),
        "absent": list(dict.fromkeys(f"{one.setting.label} on {one.task}" for one in data.absent)),
        "results": "" if results == "results" else f" results={shlex.quote(results)}",
        "baseline": data.study.baseline,
        "main": MAIN,
        "explained": explanations((row.label, row.method) for row in rows),
        "columns": f"{NOTE} {of_runs(rows)}",
        "suite": _suite(rows),
        "charts": [figure.to_dict() for figure in report.figures.values()],
        "has_bounds": "_tradeoff" in report.figures,
        "has_acceptance": "_acceptance" in report.figures,
        "tasks": _by_task(data.task_results),
        "episodes": "",  # the board gives the address of the page of episodes
        "machines": repriced_summary(report.priced) if report.priced else None,
        "assumes": ASSUMES,
        "settings": _settings(data),
        "films": [],
        "recordings": [(path.stem, _href(path, study.root)) for path in study.recordings],
        "files": [(path.name, _href(path, study.root)) for path in report.files if path.suffix == ".csv"],
    }


def _suite(results: Sequence[Result]) -> pd.DataFrame:
    """Return the page's table of settings, pooled over tasks.

    If the tasks have several difficulty groups, further columns have the unweighted mean of the groups.
    """
    frame = summary_frame(results)
    if any(";" in row.difficulty for row in results):
        macro = summary_frame(results, MACRO)
        for name in ("success", *SPEEDS.values()):
            frame[f"{name}, by difficulty"] = macro.get(name, MISSING)
    return frame


def _by_task(results: Sequence[Result]) -> pd.DataFrame:
    """Return the page's table of successes and speeds per episode, by task and setting.

    Tasks are rows and settings are columns, unless there are more settings than tasks.
    """
    cells: dict[str, dict[str, str]] = {}
    for row in results:
        cells.setdefault(row.label, {})[row.task] = _cell(row)
    table = pd.DataFrame(cells).sort_index().fillna(MISSING).rename_axis("task")
    return (table.T.rename_axis("setting") if len(table.columns) > len(table) else table).reset_index()


def _cell(row: Result) -> str:
    """Return successes / episodes and, if measured, the speed per episode, as text."""
    share = f"{row.measures.successes}/{row.episodes // max(1, row.repeats)}"
    speed = row.measures.episode_speedup.value
    return share if row.is_baseline or not is_number(speed) else f"{share} · {speed:.2f}×"


def _settings(data: StudyData) -> list[dict[str, Any]]:
    """Return for every setting its label, its overrides, its reference, and the values that differ between the two.

    The reference is the label of the setting that it is compared with.
    """
    flat = {label: flatten(without(one.settings, NOT_DETERMINING)) for label, one in data.settings.items()}
    settings = []
    for label, own in flat.items():
        reference = data.references[label]
        about = {"label": label, "overrides": data.settings[label].overrides, "reference": reference}
        settings.append({**about, "differs": differences(flat.get(reference, {}), own)})
    return settings


def _films(data: StudyData) -> list[dict[str, Any]]:
    """Return for each method a film of its first recorded success and one of its first recorded failure.

    A method without a recording of such an episode lacks that film. Without Rerun there are no films. A film is a
    dictionary with the setting's label, the task, the seed, the outcome, the number of steps and the GIF in base64.
    """
    if not has_rerun():
        return []
    keys = ["label", "task", "seed", "repeat"]
    outcomes = data.episodes.set_index(keys)["success"].to_dict()
    films: dict[tuple[str, bool], dict[str, Any]] = {}
    for one in data.study.episodes:
        path, method = data.study.rollouts / one.recording, one.setting.settings["method"]
        success = outcomes.get((one.setting.label, *one.key[1:]))
        if success is None or (method, success) in films or not path.is_file():
            continue
        if (film := film_of(path)).frames:
            slower = min(2.0, _FRAMES / len(film.frames))
            picture = base64.b64encode(animation(film, slower)).decode()
            films[method, success] = {"label": one.setting.label, "task": one.task, "seed": one.seed,
                                      "success": success, "steps": film.facts["steps"], "picture": picture}  # fmt: skip
    return list(films.values())


def _href(path: Path, folder: Path) -> str:
    """Return the address of a file relative to the page's folder."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())
