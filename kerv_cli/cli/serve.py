"""`kerv serve`: serve a policy to robots or benchmarks in other processes."""

from __future__ import annotations

import contextlib
import threading
import time

import typer

from kerv_cli.cli.command import command
from kerv_cli.cli.common import ShowPlan, end_at_once, end_with_plan
from kerv_cli.serve.settings import ServeSettings


@command(
    "serve",
    ServeSettings,
    keys="protocol policy method task host port gripper origins",
    typed={"task": "task_name"},  # renamed, because task= of other commands is a list
)
def serve(settings: ServeSettings, plan: ShowPlan = False) -> None:
    """Serve a policy with any method over websockets: observations in, actions out, until Ctrl-C.

    Examples:
        kerv serve policy=vision method=one_pass
        kerv serve protocol=vla_eval policy=state method=spec_vla
    """
    from kerv_cli.serve.policy import Policy
    from kerv_cli.serve.server import PolicyServer

    server = PolicyServer(Policy(settings), settings, _log)
    if plan:
        end_with_plan(f"{settings.policy.target} with {settings.method} on ws://{settings.host}:{settings.port}")
    with server.listening(settings.host, settings.port) as port, contextlib.suppress(KeyboardInterrupt):
        _log(f"{settings.policy.target} with {settings.method} listens on ws://{settings.host}:{port}")
        never = threading.Event()
        while not never.wait(0.1):  # the system may give a signal to another thread, and that does not wake this one
            pass
    _log("stopped")
    end_at_once()


def _log(line: str) -> None:
    typer.echo(f"{time.strftime('%H:%M:%S')} {line}", err=True)
