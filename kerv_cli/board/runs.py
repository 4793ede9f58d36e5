"""The start page: all that the results folder holds."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.board.pages import database_of, render
from kerv_cli.catalogue.entries import find_runs


def show_runs(request: Request) -> Response:
    """Show studies, artifacts and unfinished commands, newest first."""
    database = database_of(request)
    return render(request, "runs.html", runs=find_runs(database.results), results=database.results)


ROUTES = [Route("/", show_runs)]
