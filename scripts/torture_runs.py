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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WRITES = ("replace", "rename", "link", "fsync", "mkdir", "unlink", "rmdir")
"""Functions of `os` that change the disk for good, or say that it has changed."""


@dataclass(frozen=True)
class Kill:
    """When a command is killed. at: before this write, counted from 1; 0: not at a write. after: seconds; 0: never."""

    at: int = 0
    after: float = 0.0

    def __str__(self) -> str:
        return f"at write {self.at}" if self.at else f"after {self.after:.2f} s"


@dataclass(frozen=True)
class Ended:
    """How a command ended. code: its exit code, negative for a signal. cpu, wall: seconds. left: processes of its group
    outlived it."""

    code: int
    cpu: float
    wall: float
    text: str
    left: bool

    @property
    def was_killed(self) -> bool:
        """By SIGKILL."""
        return self.code == -signal.SIGKILL


def run(words: list[str], limit: float, kill: Kill | None = None, log: Path | None = None) -> Ended:
    """Runs a command in a fork of this process, in its own process group.

    limit: seconds after which it is killed as one that hangs. kill: when it is killed on purpose. log: gets a line with
    the number of writes, and one with the name of each module that it loaded.
    """
    kill, began = kill or Kill(), time.monotonic()
    with tempfile.TemporaryFile() as output:
        child = os.fork()
        if child == 0:
            _be_command(words, output.fileno(), kill.at, log)
        with contextlib.suppress(OSError):  # the child does the same: whoever is first
            os.setpgid(child, child)
        try:
            status, cpu = _wait(child, began + (kill.after or limit))
        finally:
            left = _end_group(child)
        output.seek(0)
        text = output.read().decode(errors="replace")
    return Ended(os.waitstatus_to_exitcode(status), cpu, time.monotonic() - began, text, left)


def _wait(child: int, deadline: float) -> tuple[int, float]:
    """Waits for a process, kills its group at the deadline -> its status and seconds of CPU."""
    killed = False
    while True:
        ended, status, used = os.wait4(child, os.WNOHANG)
        if ended:
            return status, used.ru_utime + used.ru_stime
        if not killed and time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
            killed = True
        time.sleep(0.003)


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
    """The child: it is the command from here on, and ends."""
    os.setpgid(0, 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    writes = _count_writes(kill_at)
    code: object = 0
    try:
        from kerv_cli.cli.app import app

        app(words)
    except SystemExit as error:
        code = error.code or 0
    except BaseException:  # noqa: BLE001 - told apart by the exit code
        import traceback

        traceback.print_exc()
        code = 99
    done = writes[0]
    if log is not None:
        log.write_text("\n".join([str(done), *sys.modules]))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 98)


def _count_writes(kill_at: int) -> list[int]:
    """Counts this process's WRITES in the list's only entry, and kills it before number `kill_at`."""
    done = [0]

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*arguments: Any, **keywords: Any) -> Any:
            done[0] += 1
            if done[0] == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **keywords)

        return counting

    for name in WRITES:
        setattr(os, name, counted(getattr(os, name)))
    return done


def load() -> None:
    """Imports and computes what every command needs, so that forks need not."""
    import torch

    from kerv_cli.base.provenance import stamp
    from kerv_cli.lab.code import code_hash
    from kerv_cli.worlds.camera import choose_backend

    torch.set_num_threads(1)
    choose_backend()
    stamp("cpu")
    code_hash()


def learn(log: Path) -> int:
    """Imports what a command loaded, by its log -> how many writes it did."""
    writes, *modules = log.read_text().splitlines()
    for name in modules:
        if name not in sys.modules:
            with contextlib.suppress(Exception):  # a name that stands for something else, as `six.moves` does
                importlib.import_module(name)
    gc.collect()
    gc.freeze()  # forks share these objects as long as nobody touches them
    return int(writes)


def warm(task: str) -> None:
    """Draws the task's placements of the first seeds of training and evaluation, and parses a grid."""
    from kerv_cli.base.config import expand
    from kerv_cli.worlds import spec_of

    expand("threshold.r=1,2 world.horizon=range(1,3) task=[a,b] a.b={c:1}")
    with spec_of(task).open_world(task) as world:
        for seed in (world.spec.seeds.training.start, world.spec.seeds.evaluation.start):
            world.reset(seed)


def names_below(folder: Path) -> set[str]:
    """Every file and folder below, relative; of a folder its name with a slash."""
    found = set()
    for root, folders, files in os.walk(folder):
        inside = Path(root).relative_to(folder)
        found |= {str(inside / name) for name in files} | {f"{inside / name}/" for name in folders}
    return found
