"""The page of a study: how far it is, its verdict, tables and charts, live while it runs."""

from __future__ import annotations

import functools
import os
import time
from typing import Any
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.base.errors import UsageError
from kerv_cli.board.pages import database_of, refreshed, render
from kerv_cli.catalogue.entries import find_runs, parents
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import RUNNING, run_rows
from kerv_cli.lab.store import Study

_SHARE = 0.01
"""Largest share of each core's time for refreshing the page of a running study, so that its times are not disturbed."""
_SECONDS = 5.0
"""Shortest time between two refreshes."""


@functools.lru_cache(maxsize=16)
def _parts(database: Database, name: str, version: str, is_running: bool) -> tuple[dict[str, Any], float]:
    """Return the values of a study's report, and the seconds to wait before the next refresh.

    Args:
        database: The database.
        name: Name of the study.
        version: `Study.version` of the study. A study is read again only if its version has changed.
        is_running: Whether the study is running. Then a cost model does not estimate its speeds, because that would
            slow the study down.
    """
    from kerv_cli.report.report import Report, study_parts  # imports Altair, which takes a second
    from kerv_cli.report.reprice import own_prices
    from kerv_cli.report.tables import load_study

    began = time.thread_time()
    data = load_study(Study(database, name))
    priced = [] if is_running else own_prices(data, elsewhere=False)
    parts = study_parts(Report(data, priced=priced))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return parts, max(_SECONDS, (time.thread_time() - began) / (_SHARE * cores))


@refreshed
def show_study(request: Request, version: str, is_live: bool) -> Response:
    """Show how far a study is. The tables follow in a second request, because many episodes take time to read."""
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
        known={one.id for one in runs},
        version=version,
        is_live=is_live and run.is_running,
    )
    if not run.is_running:
        page.headers["HX-Trigger"] = "ended"  # tables that show the running study are loaded again
    return page


def show_tables(request: Request) -> Response:
    """Show the report of a study: its verdict, tables and charts."""
    database, name = database_of(request), request.path_params["name"]
    store = Study(database, name)
    is_running = RUNNING in [one.status for one in run_rows(database, store.kind, name)]
    version = f"{store.version()}/{is_running}"
    if request.query_params.get("known") == version:
        return Response(status_code=204)
    has_episodes = store.counts()[0] > 0
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


@functools.cache
def _library() -> str:
    from kerv_cli.report.plots import library

    return library()


def send_library(request: Request) -> Response:
    """Send the library that draws charts."""
    day = {"cache-control": "max-age=86400"}
    return Response(_library(), media_type="text/javascript", headers=day)


ROUTES = [
    Route("/studies/{name}", show_study),
    Route("/studies/{name}/tables", show_tables),
    Route("/report/charts.js", send_library),
]
