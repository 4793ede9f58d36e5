"""Processes that kerv starts end with the one that started them, also where that is killed."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

from kerv_cli.base.errors import KervError

WATCH_SECONDS = 1.0
"""Between two looks at whether the parent lives."""

_PR_SET_PDEATHSIG = 1
_MARK = "KERV_GUARD"
_GUARD = """
import os, select, signal, sys
def status(process):
    try:
        with open(f"/proc/{process}/stat") as file:
            fields = file.read().rpartition(")")[2].split()
        return int(fields[1]), int(fields[19])  # parent, start
    except OSError:  # it has ended
        return None, None

def look():
    every = {process: status(process) for process in map(int, filter(str.isdigit, os.listdir("/proc")))}
    before = 0
    while before < len(below):
        before = len(below)
        here = {parent for parent, start in below.items() if every.get(parent, (0, 0))[1] == start}
        below.update({process: start for process, (parent, start) in every.items() if parent in here})

below = {int(sys.argv[1]): status(sys.argv[1])[1]}  # process -> its start; descendants, also those of ended parents
look()
old = set(below)  # of what was there before: it stays
while not select.select([sys.stdin], [], [], 1)[0]:
    look()
def marked(process):
    try:
        with open(f"/proc/{process}/environ", "rb") as file:
            return mark in file.read()
    except OSError:
        return False

mark = sys.argv[2].encode()  # in the environment of what was started since the last look
look()
every = map(int, filter(str.isdigit, os.listdir("/proc")))
below.update({process: status(process)[1] for process in every if marked(process)})
for process, start in below.items():
    if process != os.getpid() and status(process)[1] == start and (process not in old or marked(process)):
        os.kill(process, signal.SIGKILL)
"""


def end_with(parent: int) -> None:
    """End this process within seconds of its parent's end. parent: the parent's process number.

    On Linux the kernel does so, also if this process is stopped.
    """
    with contextlib.suppress(OSError, AttributeError):  # not Linux
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def check_workers() -> None:
    """Refuses worker processes where they could not wait for each other.

    Raises:
        KervError: no semaphores, on Linux because of /dev/shm.
    """
    try:
        multiprocessing.get_context("fork").Lock()
    except (OSError, ImportError) as error:
        raise KervError(f"no worker processes here, /dev/shm cannot be used ({error}): set runtime.workers=1") from None


def begin_worker(parent: int) -> None:
    """Start-up of a worker process: it ends with its parent, which alone handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with(parent)


@contextlib.contextmanager
def guard() -> Iterator[None]:
    """What is started within the block, and what that starts, ends with the block or with this process: another process
    sees to that. For servers that a library starts. Needs /proc."""
    mark = secrets.token_hex(8)
    command = [sys.executable, "-S", "-c", _GUARD, str(os.getpid()), mark]
    with subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True):  # either end closes the pipe
        os.environ[_MARK] = mark
        try:
            yield
        finally:
            os.environ.pop(_MARK, None)
