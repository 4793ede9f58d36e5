"""Assemble the web app from the routes of its modules, and serve it. Only this machine can connect."""

from __future__ import annotations

import contextlib
import socket
import threading
import webbrowser
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.board import episodes, runs
from kerv_cli.board.pages import render
from kerv_cli.board.recorder import RECORDER
from kerv_cli.lab.database import Database

HOST = "127.0.0.1"
_HOSTS = [HOST, "localhost"]
_READS = ("GET", "HEAD")
# Seconds for which a stopping board waits for answers that are being computed
LAST_ANSWERS = 1.0


class SameOrigin:
    """Refuse requests that change something, if the page of another site sends them.

    Browsers send the header Origin with every such request. Programs such as curl send none, and are let through.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] not in _READS:
            headers = Request(scope).headers
            if urlsplit(headers.get("origin", f"http://{headers['host']}")).netloc != headers["host"]:
                await PlainTextResponse("refused: another site's page sent this", 403)(scope, receive, send)
                return
        await self.app(scope, receive, send)


def make_app(database: Database) -> Starlette:
    """Return the web app of a database and its results folder. `request.app.state.database` is the database."""
    folders = {"/static": ("kerv_cli.board", "static"), "/report": ("kerv_cli.report", "templates")}
    files = [Mount(path, StaticFiles(packages=[folder])) for path, folder in folders.items()]
    app = Starlette(
        routes=[*runs.ROUTES, *episodes.ROUTES, *files],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=_HOSTS), Middleware(SameOrigin)],
        exception_handlers=dict.fromkeys((KervError, HTTPException, Exception), failed),
    )
    app.state.database = database
    return app


def failed(request: Request, error: Exception) -> Response:
    """Return the page for an error. An HTTPException keeps its status. A UsageError gets 404, any other error 500."""
    if isinstance(error, HTTPException):
        return render(request, "error.html", error.status_code, reason=error.detail)
    reason = str(error) if isinstance(error, KervError) else f"internal error, {type(error).__name__}: {error}"
    return render(request, "error.html", 404 if isinstance(error, UsageError) else 500, reason=reason)


def web_server(database: Database, **options: Any) -> uvicorn.Server:
    return uvicorn.Server(uvicorn.Config(make_app(database), log_level="critical", **options))


def serve(database: Database, port: int, opened: Callable[[str], None], browser: bool) -> None:
    """Serve the web app until Ctrl-C.

    Args:
        port: If 0, a free port is used.
        opened: Called with the address as soon as the port is open.
    """
    server = web_server(database)
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((HOST, port))
        except OSError as error:
            raise UsageError(
                f"port {port} cannot be used ({error.strerror}): port=0 takes a free one", "port"
            ) from None
        listening.listen()
        address = f"http://{HOST}:{listening.getsockname()[1]}/"
        opened(address)
        if browser:
            webbrowser.open(address)
        # a daemon, as are the threads that it starts: no answer delays the end
        answering = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        answering.start()
        with contextlib.suppress(KeyboardInterrupt):
            answering.join()
        server.should_exit = True
        answering.join(LAST_ANSWERS)
        RECORDER.close()
