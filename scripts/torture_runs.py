"""Runs kerv's commands in forks of one interpreter that has loaded Python, torch and what the commands import."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

WRITES = ("replace", "rename", "link", "fsync", "mkdir", "unlink", "rmdir")
"""Functions of `os` that change the disk for good, or say that it has changed."""


class Kill(NamedTuple):
    """When a command is killed. at: before this write, counted from 1; 0: not at a write. after: seconds; 0: never."""

    at: int = 0
    after: float = 0.0


NEVER = Kill()


class Ended(NamedTuple):
    """How a command ended. code: its exit code, negative for a signal. cpu, wall: seconds. left: processes of its group
    outlived it."""

    code: int
    cpu: float
    wall: float
    text: str
    left: bool


def run(words: list[str], limit: float, kill: Kill = NEVER, log: Path | None = None) -> Ended:
    """Runs a command in a fork of this process, in its own process group.

    limit: seconds after which it is killed as one that hangs. kill: when it is killed on purpose. log: gets a line with
    the number of writes, and one with the name of each module that it loaded.
    """
    began, killed, status = time.monotonic(), False, None
    with tempfile.TemporaryFile() as output:
        child = os.fork()
        if child == 0:
            _be_command(words, output.fileno(), kill.at, log)
        with contextlib.suppress(OSError):  # the child does the same: whoever is first
            os.setpgid(child, child)
        try:
            while status is None:
                ended, code, used = os.wait4(child, os.WNOHANG)
                status = code if ended else None
                if not (ended or killed) and time.monotonic() > began + (kill.after or limit):
                    os.killpg(child, signal.SIGKILL)
                    killed = True
                time.sleep(0.003)
        finally:
            left = _end_group(child)
        output.seek(0)
        text = output.read().decode(errors="replace")
    return Ended(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, time.monotonic() - began, text, left)


def _end_group(group: int) -> bool:
    """Kills what is left of a process group -> whether there was anything. A grandchild that has just been killed along
    takes a moment to go."""
    for _ in range(20):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.05)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)
    return True


def _be_command(words: list[str], output: int, kill_at: int, log: Path | None) -> None:
    """The child: it is the command from here on, and ends. It is killed before write number `kill_at`."""
    os.setpgid(0, 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    done, code = 0, 0

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*arguments: Any, **keywords: Any) -> Any:
            nonlocal done
            done += 1
            if done == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **keywords)

        return counting

    for name in WRITES:
        setattr(os, name, counted(getattr(os, name)))
    try:
        from kerv_cli.cli.app import app

        app(words)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 98 if error.code else 0
    except BaseException:  # noqa: BLE001 - told apart by the exit code
        traceback.print_exc()
        code = 99
    if log is not None:
        log.write_text("\n".join([str(done), *sys.modules]))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def learn(log: Path) -> int:
    """Imports what a command loaded, by its log, so that forks need not -> how many writes it did."""
    writes, *modules = log.read_text().splitlines()
    for name in modules:
        with contextlib.suppress(Exception):  # a name that stands for something else, as `six.moves` does
            importlib.import_module(name)
    gc.collect()
    gc.freeze()  # forks share these objects as long as nobody touches them
    return int(writes)
