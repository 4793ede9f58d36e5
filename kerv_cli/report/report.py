"""Write the tables and the web page of each study, from its stored episodes.

A page has a verdict, tables, charts and settings. templates/_study.html is its body.
"""

from __future__ import annotations

import base64
import functools
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import altair as alt
from jinja2 import Environment, PackageLoader, StrictUndefined

from kerv_cli.base.durations import count, duration
from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_json, write_text
from kerv_cli.episodes.identity import NOT_DETERMINING, without
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import ROLLOUT, SWEEP, Study, counts_of, studies, sweep_command
from kerv_cli.report.measures import Measures, Result, Row, columns_of, csv_text
from kerv_cli.report.plots import acceptance_figure, library, study_figures
from kerv_cli.report.profiles import NamedProfile, open_profiles
from kerv_cli.report.reprice import Priced, own_profiles, prices_table, repriced
from kerv_cli.report.summary import (
    ASSUMES,
    MAIN,
    MEANINGS,
    about,
    columns_shown,
    note_of,
    repriced_summary,
    summary,
    task_table,
    with_code,
)
from kerv_cli.report.tables import RUNTIME, StudyData, flatten, load_study
from kerv_cli.report.verdict import Verdict, caution, order_of, question, verdict_of
from kerv_cli.report.viewing.viewer import animation, film_of

# A column for each setting that the study varies follows after `overrides`. tables/<study>.json has all other values.
CSV_COLUMNS = (
    "study", "label", "method", "overrides", "stress", "stress_level", "task", "seeds", "episodes", "baseline",
    "successes", "success", "success_low", "success_high", "runs", "speedup", "speedup_low", "speedup_high",
    "episode_speedup", "episode_speedup_low", "episode_speedup_high", "solved_speedup", "solved_speedup_low",
    "solved_speedup_high", "time_per_step_ms", "time_per_episode_ms", "latency_p95_ms", "AL", "forwards_per_step",
    "skip_rate", "unverified_share", "compensation_rate", "retrieval_share", "pairs", "only_baseline", "only_method",
    "mcnemar_p", "difference", "difference_low", "difference_high", "non_inferior", "pairs_to_settle",
    "steps_to_success", "near_contact_failure",
)  # fmt: skip
# Points: default for the largest loss of success that the verdict accepts
LOSS = 3.0
# Films play at half speed. With more than half this many frames, a film plays faster, to stay short and small.
_FRAMES = 240


@dataclass(frozen=True)
class Report:
    """A report on one study: its verdict, charts and written files. Verdict and charts are computed once."""

    data: StudyData
    loss: float = LOSS  # largest loss of success, in points, that the verdict accepts
    priced: Sequence[Priced] = ()  # the study's speeds on other machines
    files: list[Path] = field(default_factory=list)  # written files, the page last

    @functools.cached_property
    def verdict(self) -> Verdict:
        return verdict_of(self.data.results, self.loss)

    @property
    def to_settle(self) -> tuple[str, str]:
        """The command that runs enough episodes for the verdict to name a setting, and how long it takes.

        Both are empty if `Verdict.episodes` is 0.
        """
        data, study, episodes = self.data, self.data.study, self.verdict.episodes
        if study.kind != SWEEP or not episodes:
            return "", ""
        more = episodes * len(study.tasks) * len(study.settings) - len(data.episodes)
        return sweep_command(study, f"episodes={episodes}"), duration(data.episodes["wall_seconds"].mean() * more)

    @functools.cached_property
    def figures(self) -> dict[str, alt.ConcatChart]:
        """The study's charts, by kind: `line`, `tradeoff`, `acceptance`."""
        data = self.data
        figures = study_figures(data.results, data.study.axis, self.loss)
        if data.tallies:
            figures["acceptance"] = acceptance_figure(data)
        return figures


def report(
    database: Database,
    study: str | None = None,
    on: Sequence[str] = (),
    loss: float = LOSS,
    baseline: str = "",
    say: Callable[[str], None] = lambda line: None,
) -> list[Report]:
    """Write the tables and the page of one study, or of every study that has an episode.

    The same episodes give the same bytes.

    Args:
        on: Names of cost profiles of other machines. The study's speeds on each are estimated (docs/measuring.md).
        loss: Largest loss of success, in points, that the verdict on the page accepts.
        baseline: Label of the setting to compare with, in place of the study's baseline.
        say: Called with a line before each part of the work that takes seconds.
    """
    if (on or baseline) and not study:
        given = f"on={','.join(on)}" if on else f"baseline={baseline}"
        raise UsageError(f"{given}: name the study with study=NAME")
    profiles, reports = open_profiles(database.results, on), []
    swept = (one for one in studies(database) if one.kind != ROLLOUT and counts_of(one)[0])
    stores = [Study(database, study)] if study else sorted(swept, key=lambda one: one.name)
    if not stores:
        raise UsageError(f"no study in {database.results} has an episode: run `kerv sweep study=demo`")
    for store in stores:
        say(f"{store.name}: reading {count(counts_of(store)[0], 'episode')}")
        data = load_study(store)
        if baseline:
            data = data.compared_with(baseline)
        say(f"{store.name}: computing tables and page")
        reports.append(write_study(data, loss, profiles))
    return reports


def write_study(data: StudyData, loss: float, profiles: Sequence[NamedProfile] = ()) -> Report:
    """Write the tables and the page of one study.

    Args:
        loss: Largest loss of success, in points, that the verdict accepts.
        profiles: Cost profiles of the machines for which speeds are estimated. If empty, those of `own_profiles`.
    """
    priced = repriced(data, profiles) if profiles else repriced(data, own_profiles(data), lenient=True)
    tables = {"": csv_rows(data, data.results), "_per_task": csv_rows(data, data.task_results)}
    tables["_on"] = prices_table(priced)
    report, folder = Report(data, loss, priced), data.study.database.results / "report" / "tables"
    for suffix, rows in tables.items():
        if rows:
            report.files.append(folder / f"{data.name}{suffix}.csv")
            write_text(report.files[-1], csv_text(rows))
    report.files.append(folder / f"{data.name}.json")
    write_json(report.files[-1], further_of(data))
    page = render(report)
    report.files.append(data.study.root / f"report{data.against}.html")
    write_text(report.files[-1], page)
    return report


def csv_rows(data: StudyData, results: Sequence[Result]) -> list[Row]:
    first, others = CSV_COLUMNS[: CSV_COLUMNS.index("overrides") + 1], CSV_COLUMNS
    served = any(result.measures.server_ms > 0 for result in results)
    names = dict.fromkeys([*first, *data.varied, *others, *(("answer_ms", "server_ms") if served else ())])
    rows = []
    for result in results:
        values = result.columns()
        rows.append({name: values.get(name) for name in names})
    return rows


def further_of(data: StudyData) -> dict[str, Any]:
    """Return the values of a study that its CSV files leave out, for JSON (docs/formats.md)."""
    labels: dict[str, Any] = {}
    for row in [*data.results, *data.task_results]:
        setting = data.settings[row.label]
        runtime = setting.settings["runtime"]
        about = {
            "name": setting.name,
            "varies": dict(setting.varies),
            "overrides": " ".join(setting.overrides),
            "settings": without(setting.settings, {"results", "task"}),
            "identity": dict(setting.identity),
            "provenance": {name: runtime[name] for name in RUNTIME} | dict(row.provenance),
            "measures": {},
        }
        measures = labels.setdefault(row.label, about)["measures"]
        measures[row.where or "micro over tasks"] = {"tasks": row.tasks} | _json_values(row.measures)
    for label, tally in data.tallies.items():
        labels[label]["acceptance"] = tally.as_dict()
    return {"study": data.name, "axis": data.study.axis, "labels": labels}


def _json_values(measures: Measures) -> Row:
    values = {}
    for name, value in columns_of(vars(measures)).items():
        if name not in CSV_COLUMNS:
            is_finite = not isinstance(value, float) or math.isfinite(value)
            values[name] = value if is_finite else None  # JSON has no NaN
    return values


def render(report: Report) -> str:
    loader = PackageLoader("kerv_cli.report", "templates")
    templates = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    templates.filters["code"] = with_code
    template = templates.get_template("study.html")
    values = study_parts(report) | {"films": _films(report.data)}
    return template.render(**values, library=library())


def study_parts(report: Report) -> dict[str, Any]:
    data = report.data
    study, rows = data.study, data.results
    suite = summary(rows)
    first, answer = rows[0].provenance, report.verdict.sentence
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
        "settles": report.to_settle,
        "caution": caution(rows),
        "missing": len(data.absent),
        "absent": list(dict.fromkeys(f"{one.setting.label} on {one.task}" for one in data.absent)),
        "again": sweep_command(study),
        "main": MAIN,
        "columns": note_of(rows, list(suite[0])[:MAIN]),
        "meanings": {name: text.format(study.baseline) for name, text in MEANINGS.items()},
        "shown": columns_shown(suite),
        "suite": suite,
        "charts": [figure.to_dict(validate=False) for figure in report.figures.values()],
        "has_bounds": "tradeoff" in report.figures,
        "has_acceptance": "acceptance" in report.figures,
        "tasks": task_table(data.task_results),
        "episodes": "",  # the board gives the address of the page of episodes
        "machines": repriced_summary(report.priced),
        "assumes": ASSUMES,
        "settings": _settings(data),
        "films": [],
        "recordings": study.recordings,
        "files": report.files,
        "href": functools.partial(_href, study.root),
    }


def _settings(data: StudyData) -> list[dict[str, Any]]:
    flat = {label: flatten(without(one.settings, NOT_DETERMINING)) for label, one in data.settings.items()}
    settings = []
    for label, own in flat.items():
        reference, words = data.references[label], " ".join(data.settings[label].overrides)
        others = flat.get(reference, {})
        differs = [(key, others.get(key), own.get(key)) for key in others | own if others.get(key) != own.get(key)]
        settings.append({"label": label, "overrides": words, "reference": reference, "differs": differs})
    return settings


def _films(data: StudyData) -> list[dict[str, Any]]:
    recorded = {path.name for path in data.study.recordings}
    outcomes = data.episodes.set_index(["label", "task", "seed"])["success"].to_dict() if recorded else {}
    films: dict[tuple[str, bool], dict[str, Any]] = {}
    for one in data.study.episodes if recorded else ():
        method, success = one.setting.settings["method"], outcomes.get((one.setting.label, *one.key[1:]))
        if success is None or (method, success) in films or one.recording not in recorded:
            continue
        path = data.study.rollouts / one.recording
        if (film := film_of(path)).frames:
            slower = min(2.0, _FRAMES / len(film.frames))
            picture = base64.b64encode(animation(film, slower)).decode()
            films[method, success] = {"label": one.setting.label, "task": one.task, "seed": one.seed,
                                      "success": success, "steps": film.facts["steps"], "picture": picture}  # fmt: skip
    return list(films.values())


def _href(folder: Path, path: Path) -> str:
    return quote(Path(os.path.relpath(path, folder)).as_posix())
