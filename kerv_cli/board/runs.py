"""The start page with everything that the results folder holds, and the comparison of two runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import starmap
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.base.errors import UsageError
from kerv_cli.board.pages import database_of, refreshed, render
from kerv_cli.catalogue.entries import RunEntry, find_runs
from kerv_cli.report.compare import compare, pairs_to_compare

STATES: dict[str, Callable[[RunEntry], bool]] = {
    "running": lambda run: run.is_running,
    "complete": lambda run: run.state == "complete",
    "unfinished": lambda run: run.state != "complete" and not run.is_running,
}
"""Choices of the filter by state."""
ORDERS: dict[str, Callable[[RunEntry], object]] = {
    "run": lambda run: run.id,
    "state": lambda run: (not run.is_running, run.state == "complete", run.state),
    "success": lambda run: -run.figures.get("success", -1.0),
    "episodes": lambda run: -run.episodes,
    "methods": lambda run: run.methods,
    "tasks": lambda run: run.tasks,
}
"""Columns by which the table can be sorted. A minus before the name reverses the order."""


@refreshed
def show_runs(request: Request, version: str, is_live: bool) -> Response:
    """Show studies, artifacts and unfinished commands. What is running comes first, unless the user sorts the page."""
    asked = {name: request.query_params.get(name, "") for name in ("kind", "state", "text", "sort")}
    only = request.app.state.only
    every = [run for run in find_runs(database_of(request)) if not only or run.id in only]
    kinds = Counter(one.kind for one in every)
    runs = [run for run in every if _agrees(run, asked)]
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
        picked=request.query_params.getlist("run"),
        address=address,
        results=database_of(request).results,
        version=version,
        is_live=is_live,
    )


def _agrees(run: RunEntry, asked: dict[str, str]) -> bool:
    is_in_state = STATES.get(asked["state"], lambda run: True)
    words = " ".join((run.id, run.kind, *run.methods, *run.tasks, *run.labels.values())).lower()
    return asked["kind"] in ("", run.kind) and is_in_state(run) and asked["text"].strip().lower() in words


def show_comparison(request: Request) -> Response:
    """Show how two runs differ in settings and results: `/compare?run=A&run=B`."""
    names = request.query_params.getlist("run")
    if len(names) != 2:
        raise UsageError("choose two runs to compare")
    pairs = pairs_to_compare(database_of(request), *names)
    return render(request, "compare.html", names=names, comparisons=list(starmap(compare, pairs)))


ROUTES = [Route("/", show_runs), Route("/compare", show_comparison)]
