"""Executor for this machine. Work runs in worker processes (loky); a single worker is this process itself."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli.base.processes import begin_worker
from kerv_cli.lab.executors import THREAD_VARIABLES, Executor, WorkerLost, in_thread, settle

T = TypeVar("T")


def build(options: Any, slots: int, threads: int, folder: Path) -> Executor:
    """Return an executor with `slots` workers. A single worker is this process itself."""
    return InProcess() if slots == 1 else Processes(slots, threads)


class InProcess:
    """Runs each function immediately in this process. A KeyboardInterrupt reaches the caller."""

    slots = 1

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Run a function, and return a completed future."""
        future: Future[T] = Future()
        settle(future, work)
        return future

    def close(self, abandon: bool) -> None:
        """Do nothing: there is no worker process."""


class Processes:
    """Runs functions in worker processes. Each has its own loky pool, so that a crash loses only one block."""

    def __init__(self, slots: int, threads: int) -> None:
        self.slots, self.threads = slots, threads
        self._free: list[Any] = []
        self._all: list[Any] = []

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Give a function to a free worker process, or start a new one. Return the future of its result.

        Call it in the main thread. A worker process ends with the thread that started it, see `end_with`.
        """
        from joblib.externals.loky.process_executor import BrokenProcessPool

        pool = self._free.pop() if self._free else self._new_pool()
        try:
            future = pool.submit(work)
        except BrokenProcessPool:  # the process died after its last block
            self._all.remove(pool)
            return self.submit(work)
        return in_thread(lambda: self._result(pool, future))

    def _result(self, pool: Any, future: Future[T]) -> T:
        """Wait until a worker process has finished its work, and return the result.

        Args:
            pool: The loky pool of the worker process.
            future: The work.

        Raises:
            WorkerLost: The process died.
        """
        from joblib.externals.loky.process_executor import BrokenProcessPool

        if isinstance(error := future.exception(), BrokenProcessPool):
            self._all.remove(pool)
            signals = re.findall(r"SIG[A-Z]+", str(error))
            raise WorkerLost(f"its worker process was {f'killed by {signals[0]}' if signals else 'lost'}")
        self._free.append(pool)
        return future.result()

    def _new_pool(self) -> Any:
        from joblib.externals.loky import ProcessPoolExecutor

        # loky warns when it replaces a worker that uses too much memory; no work is lost
        warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given", category=UserWarning)
        pool = ProcessPoolExecutor(
            max_workers=1,
            initializer=begin_worker,
            initargs=(os.getpid(),),
            env=dict.fromkeys(THREAD_VARIABLES, str(self.threads)),
        )
        self._all.append(pool)
        return pool

    def close(self, abandon: bool) -> None:
        """End the worker processes after their work; with `abandon`, kill them."""
        for pool in list(self._all):
            pool.shutdown(wait=True, kill_workers=abandon)
