"""Write the tables, plots and web page of each study, from its stored episodes.

A page has a verdict, tables, charts and settings. templates/_study.html is its body.
"""

from __future__ import annotations

import base64
import functools
import math
import os
import shlex
from collections.abc import Iterable, Sequence
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
from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import Result, Row, averaged, columns_of, compared, csv_text, frame_of
from kerv_cli.report.plots import about, acceptance_figure, latency_figure, library, png, study_figures
from kerv_cli.report.profiles import NamedProfile, open_profiles
from kerv_cli.report.reprice import Priced, own_prices, prices_table, repriced
from kerv_cli.report.statistics import PairedCounts
from kerv_cli.report.summary import (
    ASSUMES,
    MAIN,
    explanations,
    note_of,
    repriced_summary,
    suite_table,
    task_table,
    with_code,
)
from kerv_cli.report.tables import RUNTIME, StudyData, differences, flatten, is_stressed, load_study, split_values
from kerv_cli.report.verdict import Verdict, caution, order_of, question, verdict_of
from kerv_cli.report.viewing.viewer import animation, film_of

CSV_COLUMNS = (
    "study", "averaging", "label", "method", "stress", "stress_level", "task", "seeds", "episodes", "baseline",
    "successes", "success", "success_low", "success_high", "runs", "speedup", "speedup_low", "speedup_high",
    "episode_speedup", "episode_speedup_low", "episode_speedup_high", "solved_speedup", "solved_speedup_low",
    "solved_speedup_high", "time_per_step_ms", "time_per_episode_ms", "latency_p95_ms", "AL", "forwards_per_step",
    "skip_rate", "unverified_share", "compensation_rate", "retrieval_share", "pairs", "only_baseline", "only_method",
    "mcnemar_p", "difference", "difference_low", "difference_high", "non_inferior", "pairs_to_settle",
    "steps_to_success", "near_contact_failure", "matched_success_speed",
)  # fmt: skip
"""Columns of a study's CSV files. All other values are in tables/<study>.json (`further_of`)."""
LOSS = 3.0
"""Default for the largest loss of success that the page's verdict accepts, in points."""
_FRAMES = 240
"""Films play at half speed. A film with more than half this number of frames plays faster, to stay short and small."""


def to_report(database: Database, study: str | None) -> list[Study]:
    """Return the studies to report.

    Args:
        database: The database.
        study: Name of one study. If None, return every study that has at least one episode, sorted by name.

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
        priced: The study's speeds on other machines. Empty if none were estimated.
        files: Written files, in the order of writing, the page last. Empty if nothing was written.
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

        Empty if the verdict names a setting already, if more episodes would not help, if more than 10,000 pairs would
        be needed, or if the study is not a sweep.
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

    The tables are <study>.csv, <study>_per_task.csv, <study>.json and, if `on` names a profile, <study>_on.csv. The
    same episodes give the same bytes.

    Args:
        database: The database. Files are written to its results folder.
        study: Name of the study. If None, report on all studies.
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
        profiles: Cost profiles of the machines for which speeds are estimated. If empty, use the profiles that the
            study's file names, and measured profiles of the machine that ran the study.
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
    tables = {"": data.table[list(CSV_COLUMNS)], "_per_task": data.per_task[list(CSV_COLUMNS)]}
    if priced:
        tables["_on"] = prices_table(priced)
    if len(data.latencies):
        tables["_latency"] = data.latencies
    if is_stressed(data.results):
        tables["_summed"] = summed_table(data.results)
    report, name = Report(data, loss, priced), data.name
    folder = data.study.database.results if publish else data.study.database.results / "report"
    for suffix, table in tables.items():
        report.files.append(folder / "tables" / f"{name}{suffix}.csv")
        write_text(report.files[-1], csv_text(table))
    report.files.append(folder / "tables" / f"{name}.json")
    write_json(report.files[-1], further_of(data))
    for suffix, figure in report.figures.items():
        report.files.append(folder / "plots" / f"{name}{suffix}.png")
        write_bytes(report.files[-1], png(figure, data.study.title or data.study.name, about(data.results)))
    page = render(report)
    report.files.append(data.study.root / f"report{data.against}.html")
    write_text(report.files[-1], page)
    return report


class Unpublishable(KervError):
    """A study does not meet the conditions for publishing."""


def refusals(results: Sequence[Result]) -> list[str]:
    """Return the reasons why a study may not be published, as clauses of an error message. Empty if there are none.

    Args:
        results: The study's rows over all tasks.
    """
    table, clauses = frame_of(results), []
    if any(commit.endswith("+changes") or commit in ("none", "") for commit in split_values(table["git_commit"])):
        clauses.append("some episodes were computed by code that is not committed")
    origins = {"git_commit": "commits", "host": "machines", "device_name": "devices", "engine": "engines"}
    for column, what in origins.items():
        if (number := len(split_values(table[column]))) > 1:
            clauses.append(f"its episodes are from {number} {what}")
    table = table[(table["label"] != table["baseline"]) & (table["pairs"] > 0)]
    for column, what in {"same_run": "in one run with", "same_block": "in turn with"}.items():
        labels = table.loc[table[column] < 1, "label"].unique()
        if len(labels):
            clauses.append(f"not measured {what} the baseline: {', '.join(labels)}")
    return clauses


def further_of(data: StudyData) -> dict[str, Any]:
    """Return the facts about a study that its CSV files leave out, as JSON values.

    Returns:
        A dictionary with the keys `study` (its name), `axis` (key of the plots' x axis) and `labels`. The value of
        `labels` maps each setting's label to a dictionary with these keys:

        - `name`, `overrides` and `settings` of the setting
        - `varies`: the keys that differ between the settings of the same grid, with this setting's values. A grid is
          the settings that one entry of the study expands to.
        - `identity`: hashes of weights and data
        - `provenance`: executor, machine, versions and the like
        - `measures`: for each averaging and each task, the measures that have no column in the CSV files
        - `acceptance`: how many draft tokens were accepted, over all tasks. Missing if no drafts were verified.
    """
    labels: dict[str, Any] = {}
    for row in [*data.results, *data.task_results]:
        setting = data.settings[row.label]
        runtime = setting.settings["runtime"]
        about = {
            "name": setting.name,
            "varies": dict(setting.varies),
            "overrides": setting.overrides,
            "settings": without(setting.settings, {"results", "task"}),
            "identity": dict(setting.identity),
            "provenance": {name: runtime[name] for name in RUNTIME} | dict(row.provenance),
            "measures": {},
        }
        values: Row = {"tasks": row.tasks, "difficulty": row.difficulty}
        for name, value in columns_of(vars(row.measures)).items():
            if name not in CSV_COLUMNS:
                is_finite = not isinstance(value, float) or math.isfinite(value)
                values[name] = value if is_finite else None  # JSON has no NaN
        labels.setdefault(row.label, about)["measures"][row.where] = values
    for label, tally in data.tallies.items():
        labels[label]["acceptance"] = tally.as_dict()
    return {"study": data.name, "axis": data.study.axis, "labels": labels}


def summed_table(results: Iterable[Result]) -> pd.DataFrame:
    """Pool a study's stressed episodes in three ways: by kind of stress, by level, and all together.

    Each pooled row is compared with the baseline's episodes from the same initial states under the same stresses.

    Returns:
        One row for each method and each way of pooling. `method` is the setting's label without stress. `sum` says what
        was pooled, such as `push`, `level 2` or `all`. `label` joins `method` and `sum`. The other columns are the same
        as in a study's table.
    """
    rows = frame_of(averaged(results))
    rows = rows[rows["stress_level"] > 0]
    reference = "".join(rows.loc[rows["label"] == rows["baseline"], "unstressed"][:1])
    counted = ["episodes", "successes", *PairedCounts._fields]
    sums = []
    for names in (rows["stress"], "level " + rows["stress_level"].astype(str), pd.Series("all", rows.index)):
        for name, part in rows.groupby(names):
            for method, pooled in part.groupby("unstressed", sort=False)[counted].sum().iterrows():
                episodes, successes, *outcomes = pooled.tolist()
                counts = PairedCounts(*outcomes)
                about = {"study": rows["study"].iloc[0], "label": f"{method} {name}", "method": method, "sum": name}
                success = {"episodes": episodes, "successes": successes, "success": stats.wilson(successes, episodes)}
                change = compared(counts, stats.paired_difference(counts))
                sums.append(columns_of({**about, "baseline": f"{reference} {name}", **success, **change}))
    return pd.DataFrame(sums)


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
    data = report.data
    study, rows = data.study, data.results
    first, results, answer = rows[0].provenance, str(study.database.results), report.verdict.sentence
    if not answer.startswith(tuple(row.label for row in rows)):  # a label stays as it is
        answer = answer[:1].upper() + answer[1:]
    return {
        # not the study itself: the board keeps these values, and the episodes of many studies would fill its memory
        "of": {name: getattr(study, name) for name in ("name", "title", "note", "baseline")},
        "wanted": len(study.episodes),
        "about": f"{about(rows)} · kerv {first['kerv_version']} at {first['git_commit'][:12]}",
        "question": question(rows, report.loss),
        "verdict": report.verdict,
        "answer": answer,
        "order": order_of(data.by_speed),
        "settles": report.command_to_settle,
        "caution": caution(rows),
        "missing": len(data.absent),
        "absent": list(dict.fromkeys(f"{one.setting.label} on {one.task}" for one in data.absent)),
        "results": "" if results == "results" else f" results={shlex.quote(results)}",
        "main": MAIN,
        "explained": explanations(study.settings),
        "columns": note_of(rows),
        "suite": suite_table(rows),
        "charts": [figure.to_dict() for figure in report.figures.values()],
        "has_bounds": "_tradeoff" in report.figures,
        "has_acceptance": "_acceptance" in report.figures,
        "tasks": task_table(data.task_results),
        "episodes": "",  # the board gives the address of the page of episodes
        "machines": repriced_summary(report.priced) if report.priced else None,
        "assumes": ASSUMES,
        "settings": _settings(data),
        "films": [],
        "recordings": study.recordings,
        "files": report.files,
        "href": functools.partial(_href, study.root),
    }


def _settings(data: StudyData) -> list[dict[str, Any]]:
    """Return for every setting: label, overrides, reference, and the values that differ from the reference's values.

    The reference is the setting with which this setting is compared.
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

    A method without a recorded success, or without a recorded failure, lacks that film. Without Rerun there are no
    films. A film is a dictionary with the setting's label, the task, the seed, the outcome, the number of steps and
    the GIF in base64.
    """
    if not has_rerun():
        return []
    keys = ["label", "task", "seed"]
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


def _href(folder: Path, path: Path) -> str:
    """Return the address of the file `path` for a link in a page, relative to the page's `folder`."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())
