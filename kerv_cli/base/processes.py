"""Make worker processes end when the process that started them ends, even if it is killed."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor

WATCH_SECONDS = 1.0  # seconds between two checks whether the parent process is alive

_PR_SET_PDEATHSIG = 1
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def begin_worker(parent: int) -> None:
    """Prepare this process as a worker. The worker ignores Ctrl-C, which its parent handles.

    The worker ends at most a few seconds after its parent. On Linux the kernel also ends a worker when the thread that
    started it ends. So start workers from a thread that lives as long as they do. Libraries that are imported later
    compute in one thread, because the workers share the cores.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    with contextlib.suppress(OSError, AttributeError):  # not Linux
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class Workers(ProcessPoolExecutor):
    """A pool of `count` worker processes. Each is a new interpreter: a fork could deadlock in a library.

    Create the pool in a thread that lives as long as the workers; see `begin_worker`.
    """

    def __init__(self, count: int) -> None:
        super().__init__(count, multiprocessing.get_context("spawn"), begin_worker, (os.getpid(),))

    def kill(self) -> None:
        processes = list((self._processes or {}).values())
        self.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()


def end_with_input() -> None:
    """Make this process end when its standard input, a pipe from the parent, is closed. Ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 1024):
                pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
