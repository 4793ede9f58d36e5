"""Helpers of all pages: render a template, format values, and find files in the results folder."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from kerv_cli.catalogue.entries import few
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import pulse
from kerv_cli.report.summary import number, with_code

TEMPLATES = Environment(
    loader=ChoiceLoader([PackageLoader("kerv_cli.board"), PackageLoader("kerv_cli.report")]),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)

CONTENT_POLICY = "content-security-policy"
# The board's pages load only the board's files, and no inline script or style.
_OWN_CONTENT = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)


def page_of(run: str) -> str:
    return f"/artifacts/{quote(run)}" if "/" in run else f"/studies/{quote(run)}"


TEMPLATES.filters |= {"few": few, "page_of": page_of, "figure": number, "code": with_code}


def database_of(request: Request) -> Database:
    return request.app.state.database


def refreshed(page: Callable[[Request, str, bool], Response]) -> Callable[[Request], Response]:
    """Decorate a function that makes a page which the browser requests again and again.

    The function is called only if the database has changed since the last request. It gets the request, the database's
    version, and whether any command is running.
    """

    @functools.wraps(page)
    def answer(request: Request) -> Response:
        version, is_live = pulse(database_of(request))
        if request.query_params.get("known") == version:
            return Response(status_code=204)  # htmx leaves the page as it is
        return page(request, version, is_live)

    return answer


def render(request: Request, template: str, status: int = 200, **values: Any) -> HTMLResponse:
    """Return a page from a file in `templates/`. The values are escaped."""
    text = TEMPLATES.get_template(template).render(request=request, **values)
    return HTMLResponse(text, status, {CONTENT_POLICY: _OWN_CONTENT})


def inside(request: Request, path: Path) -> Path:
    """Resolve the symbolic links of a path. Answer 404 if it then is not an existing path in the results folder."""
    resolved = path.resolve()
    if not resolved.is_relative_to(database_of(request).results.resolve()) or not resolved.exists():
        raise HTTPException(404, "no such file in the results folder")
    return resolved
