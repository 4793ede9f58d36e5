"""Let worker processes end together with the process that started them, even if that one is killed."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import threading
import time

from kerv_cli.base.errors import KervError

WATCH_SECONDS = 1.0
"""Seconds between two looks at whether the parent process lives."""

_PR_SET_PDEATHSIG = 1


def end_with(parent: int) -> None:
    """End this process within seconds of its parent's end.

    On Linux the kernel does it, even if this process is stopped.

    Args:
        parent: Number of the parent process.
    """
    with contextlib.suppress(OSError, AttributeError):  # not Linux
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def check_workers() -> None:
    """Refuse worker processes on a machine where they could not wait for each other.

    Raises:
        KervError: No semaphores; on Linux because of /dev/shm.
    """
    try:
        multiprocessing.get_context("fork").Lock()
    except (OSError, ImportError) as error:
        raise KervError(f"no worker processes here, /dev/shm cannot be used ({error}): set runtime.workers=1") from None


def begin_worker(parent: int) -> None:
    """Start a worker process: it ends with its parent, and only the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with(parent)
