"""Processes that kerv starts end with the one that started them, also where that is killed."""

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
"""Between two looks at whether the parent lives."""

_PR_SET_PDEATHSIG = 1


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
