"""The page of an artifact: what it was made from, what was made from it, and the curves of its training."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.board.pages import database_of, refreshed, render
from kerv_cli.catalogue.entries import RunEntry, children, description_of, disk_bytes, find_run, find_runs, parents
from kerv_cli.report.tables import flatten


@refreshed
def show_artifact(request: Request, version: str, is_live: bool) -> Response:
    """Show one artifact, and its curves while it is trained."""
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
        known={one.id for one in runs},
        chart=_curves(run),
        settings=flatten(described.get("settings", {})),
        commit=described.get("git_commit", ""),
        version=version,
        is_live=is_live and run.is_running,
    )


def _curves(run: RunEntry) -> dict[str, object] | None:
    """Return a training's curves as a Vega-Lite chart. None for other artifacts, and before the second validation."""
    from kerv_cli.report.plots import curves_figure, read_log

    try:
        log = read_log(run.folder)
    except KervError:
        return None
    first = [name for name in ("step", "score", "train_loss") if name in log]
    return curves_figure(log[[*first, *log.columns.drop(first)]]).to_dict() if len(log) > 1 else None


ROUTES = [Route("/artifacts/{name:path}", show_artifact)]
