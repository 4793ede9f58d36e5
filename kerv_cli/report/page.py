"""The page of a study: verdict, tables, charts and settings. templates/_study.html is its body."""

from __future__ import annotations

import base64
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import altair as alt
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from kerv_cli.base.errors import has_rerun
from kerv_cli.episodes.identity import NOT_DETERMINING, without
from kerv_cli.lab.store import SWEEP
from kerv_cli.report.glossary import explanations, with_code
from kerv_cli.report.plots import about, acceptance_figure, latency_figure, library, study_figures
from kerv_cli.report.reprice import ASSUMES, Priced, repriced_summary
from kerv_cli.report.results import MACRO, Result, is_number
from kerv_cli.report.summary import MAIN, MISSING, NOTE, SPEEDS, of_runs, summary_frame
from kerv_cli.report.tables import StudyData, differences, flatten, latency_table
from kerv_cli.report.verdict import caution, episodes_to_settle, order_of, question, verdict_of
from kerv_cli.report.viewing.film import animation, film_of

LOSS = 3.0
"""Default for the largest loss of success that the page's verdict accepts, in points."""
_FRAMES = 240
"""Films play at half speed. One with more than half this number of frames plays faster, to stay short and small."""


def render(data: StudyData, loss: float, priced: Sequence[Priced] = (), tables: Sequence[Path] = ()) -> str:
    """Return the study's page as one HTML file that needs no other file and no network.

    Args:
        data: The study's episodes and tables.
        loss: Largest loss of success, in points, that the verdict accepts.
        priced: The study's speeds on other machines, from `repriced`.
        tables: CSV files of the study, which are linked.
    """
    loader = PackageLoader("kerv_cli.report", "templates")
    templates = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    templates.filters["code"] = with_code
    template = templates.get_template("study.html")
    values = study_parts(data, loss, priced, tables) | {"films": _films(data)}
    return template.render(**values, library=library())


def study_parts(
    data: StudyData, loss: float = LOSS, priced: Sequence[Priced] = (), tables: Sequence[Path] = ()
) -> dict[str, Any]:
    """Return the values that the template _study.html shows.

    Args:
        data: The study's episodes and tables.
        loss: Largest loss of success, in points, that the verdict accepts.
        priced: The study's speeds on other machines, from `repriced`.
        tables: CSV files of the study, which are linked.
    """
    study, rows = data.study, data.results
    answer, is_shown = verdict_of(rows, loss)
    more = episodes_to_settle(rows, loss)
    first, results, figures = rows[0].provenance, str(study.database.results), figures_of(data, loss)
    return {
        "name": study.name,
        "title": data.study.title or study.name,
        "note": data.study.note,
        "about": f"{about(rows)} · kerv {first['kerv_version']} at {first['git_commit'][:12]}",
        "question": question(rows, loss),
        "verdict": answer[:1].upper() + answer[1:],
        "is_shown": is_shown,
        "order": order_of(data.by_speed),
        "settles": study.sweep_command(f"episodes={more}") if more and study.kind == SWEEP else "",
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
        "charts": [figure.to_dict() for figure in figures.values()],
        "has_bounds": "_tradeoff" in figures,
        "has_acceptance": "_acceptance" in figures,
        "tasks": _by_task(data.task_results),
        "episodes": "",  # the board gives the address of the page of episodes
        "machines": repriced_summary(priced) if priced else None,
        "assumes": ASSUMES,
        "settings": _settings(data),
        "films": [],
        "recordings": [(path.stem, _href(path, study.root)) for path in study.recordings],
        "files": [(path.name, _href(path, study.root)) for path in tables],
    }


def figures_of(data: StudyData, loss: float) -> dict[str, alt.ConcatChart]:
    """Return the study's charts.

    Each key is the suffix of a file name: `_latency` is the chart for `<study>_latency.png`. `loss` is the largest
    acceptable loss of success, in points.
    """
    figures = study_figures(data.results, data.study.axis, loss)
    if len(latency_table(data.results)):
        figures["_latency"] = latency_figure(data.results)
    if data.tallies:
        figures["_acceptance"] = acceptance_figure(data.tallies, data.references)
    return figures


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
    """Return every setting's label, overrides, and the values in which it differs from the one it is compared with."""
    flat = {label: flatten(without(one.settings, NOT_DETERMINING)) for label, one in data.settings.items()}
    settings = []
    for label, own in flat.items():
        reference = data.references[label]
        about = {"label": label, "overrides": data.settings[label].overrides, "reference": reference}
        settings.append({**about, "differs": differences(flat.get(reference, {}), own)})
    return settings


def _films(data: StudyData) -> list[dict[str, Any]]:
    """Return for each method a film of its first recorded success and one of its first recorded failure.

    If no episode with an outcome was filmed, there is no film of it. Without Rerun there is no film. A film is a
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
