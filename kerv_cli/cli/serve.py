"""`kerv serve`: a policy for a robot that is not in this process."""

from __future__ import annotations

import signal
import threading
import time

import typer

from kerv_cli.cli import common
from kerv_cli.cli.common import Overrides, ShowConfig, ShowPlan, edge


@edge
def serve(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Answer observations with actions over websockets (openpi's protocol), with any method, until Ctrl-C."""
    from kerv_cli.base.settings import ServeSettings

    # here task=NAME is one task's name; elsewhere it is a list
    words = [f"task_name={o[5:]}" if o.startswith("task=") else o for o in overrides or []]
    settings = common.composed("serve", words, ServeSettings, cfg)
    from kerv_cli.serve.policy import served
    from kerv_cli.serve.server import PolicyServer

    interface, decoder = served(settings)
    if plan:
        common.print_plan(f"{settings.policy.target} with {settings.method} on ws://{settings.host}:{settings.port}")
    server = PolicyServer(interface, decoder, _log, settings.max_mb, settings.log_every)
    with server.listening(settings.host, settings.port) as listening:
        port = listening.socket.getsockname()[1]
        _log(f"{settings.policy.target} with {settings.method} listens on ws://{settings.host}:{port}")
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: threading.Thread(target=listening.shutdown).start())
        listening.serve_forever()
    _log("stopped")


def _log(line: str) -> None:
    typer.echo(f"{time.strftime('%H:%M:%S')} {line}", err=True)
