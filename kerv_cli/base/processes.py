"""Make worker processes end when the process that started them ends, even if it is killed."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import threading
import time

WATCH_SECONDS = 1.0
"""Seconds between two checks whether the parent process is alive."""

_PR_SET_PDEATHSIG = 1


def end_with(parent: int) -> None:
    """Make this process end when its parent process ends, at most a few seconds later.

    On Linux the kernel ends it, even if it is suspended. The kernel also ends it if only the thread ends that started
    it: start workers from a thread that lives as long as they do.

    Args:
        parent: Process id of the parent.
    """
    with contextlib.suppress(OSError, AttributeError):  # not Linux
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def begin_worker(parent: int) -> None:
    """Prepare this process as a worker: it ends when its parent ends, and ignores Ctrl-C, which its parent handles.

    Args:
        parent: Process id of the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with(parent)


def end_with_input() -> None:
    """Make this process end when its standard input ends: a pipe that its parent holds, and never writes to.

    It also ignores Ctrl-C, which its parent handles.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 1024):
                pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
