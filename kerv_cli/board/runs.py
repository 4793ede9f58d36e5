"""The pages of runs: the start page, a study with its tables and charts, an artifact with its curves."""

from __future__ import annotations

import functools
import os
import time
from collections import Counter
from collections.abc import Callable
from operator import attrgetter
from typing import Any
from urllib.parse import quote, urlencode

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.board.pages import database_of, refreshed, render
from kerv_cli.catalogue.entries import RunEntry, children, description_of, disk_bytes, find_run, find_runs, parents
from kerv_cli.episodes.identity import hash_of
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import RUNNING, run_rows
from kerv_cli.lab.store import ABOUT, Study, counts_of, loaded, version_of
from kerv_cli.report.tables import flatten

# Choice of the filter by state -> whether a run is shown
STATES: dict[str, Callable[[RunEntry], bool]] = {
    "running": lambda run: run.is_running,
    "complete": lambda run: run.state == "complete",
    "unfinished": lambda run: run.state != "complete" and not run.is_running,
}
# Columns by which the table can be sorted -> the sort key of a run. A minus before the name reverses the order.
ORDERS: dict[str, Callable[[RunEntry], object]] = {
    "run": lambda run: run.id,
    "state": lambda run: (not run.is_running, run.state == "complete", run.state),
    "success": lambda run: -run.figures.get("success", -1.0),
    "episodes": lambda run: -run.episodes,
    "methods": lambda run: run.methods,
    "tasks": lambda run: run.tasks,
}
# Share of all cores' time for refreshing a running study's page, so that measured times are not disturbed
_SHARE = 0.01
# Shortest time between two refreshes of a study's tables
_SECONDS = 5.0


@refreshed
def show_runs(request: Request, version: str, is_live: bool) -> Response:
    """Show studies, artifacts and unfinished commands. Running ones come first, unless the user sorts the table."""
    asked = {name: request.query_params.get(name, "") for name in ("kind", "state", "text", "sort")}
    every = find_runs(database_of(request))
    kinds = Counter(map(attrgetter("kind"), every))
    is_in_state = STATES.get(asked["state"], lambda run: True)
    runs = []
    for run in every:
        words = " ".join((run.id, run.kind, *run.methods, *run.tasks)).lower()
        if asked["kind"] in ("", run.kind) and is_in_state(run) and asked["text"].strip().lower() in words:
            runs.append(run)
    order = asked["sort"].removeprefix("-")
    if order in ORDERS:
        runs.sort(key=ORDERS[order], reverse=asked["sort"].startswith("-"))  # type: ignore[arg-type]
    else:
        runs.sort(key=lambda run: not run.is_running)

    def address(**changes: str) -> str:
        return f"?{urlencode({name: value for name, value in (asked | changes).items() if value})}"

    return render(
        request,
        "runs.html",
        runs=runs,
        number=len(every),
        kinds=kinds,
        states=STATES,
        asked=asked,
        address=address,
        results=database_of(request).results,
        version=version,
        is_live=is_live,
    )


@functools.lru_cache(maxsize=16)
def _parts(database: Database, name: str, version: str, is_running: bool) -> tuple[dict[str, Any], float]:
    """Return the values of a study's report, and the seconds to wait before the next refresh.

    A running study's report has no speeds from a cost model, because computing them would slow the study down.
    """
    from kerv_cli.report.report import Report, study_parts  # imports Altair, which takes a second
    from kerv_cli.report.reprice import own_profiles, repriced
    from kerv_cli.report.tables import load_study

    began = time.thread_time()
    data = load_study(Study(database, name))
    priced = [] if is_running else repriced(data, own_profiles(data, elsewhere=False), lenient=True)
    parts = study_parts(Report(data, priced=priced))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return parts, max(_SECONDS, (time.thread_time() - began) / (_SHARE * cores))


@refreshed
def show_study(request: Request, version: str, is_live: bool) -> Response:
    """Show the progress of a study. A second request loads the tables, because many episodes take time to read."""
    database = database_of(request)
    runs = find_runs(database)
    run = next((run for run in runs if run.id == request.path_params["name"] and run.has_episodes), None)
    if run is None:
        raise UsageError(f"there is no study '{request.path_params['name']}'")
    page = render(
        request,
        "study_page.html",
        run=run,
        title=run.id,
        parents=parents(run, runs),
        known=set(map(attrgetter("id"), runs)),
        version=version,
        is_live=is_live and run.is_running,
    )
    if not run.is_running:
        page.headers["HX-Trigger"] = "ended"  # tables that show the running study are loaded again
    return page


def show_tables(request: Request) -> Response:
    database, name = database_of(request), request.path_params["name"]
    store = loaded(Study(database, name), episodes=False)
    is_running = RUNNING in map(attrgetter("status"), run_rows(database, store.kind, name))
    # what a report shows besides episodes: how the study is described, and profiles by which its decodes are priced
    profiles = {path.name: path.stat().st_mtime for path in (database.results / "bench").glob("*.json")}
    described = [getattr(store, name) for name in ABOUT], [one.work for one in store.settings], sorted(profiles.items())
    version = f"{version_of(store)}/{is_running}/{hash_of(described)}"
    if request.query_params.get("known") == version:
        return Response(status_code=204)
    has_episodes = counts_of(store)[0] > 0
    parts, seconds = _parts(database, name, version, is_running) if has_episodes else ({}, _SECONDS)
    hidden: dict[str, Any] = {"recordings": [], "files": []} | ({"missing": 0} if is_running else {})
    if len(parts.get("settings", ())) == 1:
        hidden["charts"] = []  # nothing to compare
    return render(
        request,
        "study_tables.html",
        study=name,
        has_episodes=has_episodes,
        is_running=is_running,
        version=version,
        seconds=round(seconds),
        **parts | hidden | {"episodes": f"/studies/{quote(name)}/episodes"},
    )


def send_library(request: Request) -> Response:
    from kerv_cli.report.plots import library

    return Response(library(), media_type="text/javascript", headers={"cache-control": "max-age=86400"})


@refreshed
def show_artifact(request: Request, version: str, is_live: bool) -> Response:
    database = database_of(request)
    runs = find_runs(database)
    run = find_run(database, request.path_params["name"], exact=True)
    if not run.folder.is_relative_to(database.results):
        raise UsageError(f"{run.id} is outside {database.results}")
    described = description_of(run)
    return render(
        request,
        "artifact.html",
        run=run,
        size=disk_bytes(run.folder),
        parents=parents(run, runs),
        children=children(run, runs),
        known=set(map(attrgetter("id"), runs)),
        chart=_curves(run),
        settings=flatten(described.get("settings", {})),
        commit=described.get("git_commit", ""),
        version=version,
        is_live=is_live and run.is_running,
    )


def _curves(run: RunEntry) -> dict[str, object] | None:
    from kerv_cli.report.plots import curves_figure, read_log

    try:
        log = read_log(run.folder)
    except KervError:
        return None
    first = [name for name in ("step", "score", "train_loss") if name in log]
    return curves_figure(log[[*first, *log.columns.drop(first)]]).to_dict() if len(log) > 1 else None


ROUTES = [
    Route("/", show_runs),
    Route("/studies/{name}", show_study),
    Route("/studies/{name}/tables", show_tables),
    Route("/report/charts.js", send_library),
    Route("/artifacts/{name:path}", show_artifact),
]
