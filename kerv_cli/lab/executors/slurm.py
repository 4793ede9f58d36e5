"""Runs blocks as jobs of a Slurm cluster, through submitit. With `cluster: local` jobs are processes of this machine.

The nodes must share the results folder. A job that the cluster ends is a lost worker.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli.base.errors import UsageError
from kerv_cli.lab.executors import THREAD_VARIABLES, Executor, SlurmOptions, WorkerLost
from kerv_cli.lab.executors.guard import guard

T = TypeVar("T")

_POLL_SECONDS = {"local": 0.2, "slurm": 5.0}


def build(options: SlurmOptions, slots: int, threads: int, folder: Path) -> Executor:
    """Return an executor whose jobs have `threads` processors each.

    Raises:
        UsageError: This machine has no Slurm, or Slurm refuses the options.
    """
    import submitit

    if options.cluster not in _POLL_SECONDS:
        raise UsageError(f"runtime.executor_options.cluster={options.cluster}: known are {', '.join(_POLL_SECONDS)}")
    try:
        jobs = submitit.AutoExecutor(folder=folder, cluster=options.cluster)
        jobs.update_parameters(
            name="kerv",
            timeout_min=options.minutes,
            cpus_per_task=threads,
            mem_gb=options.memory_gb,
            gpus_per_node=options.gpus,
            slurm_setup=[*options.setup, *(f"export {name}={threads}" for name in THREAD_VARIABLES)],
            **({"slurm_partition": options.partition} if options.partition else {}),
        )
    except (RuntimeError, ValueError, TypeError) as error:
        raise UsageError(f"Slurm cannot be used from here: {' '.join(str(error).split())}") from None
    stack = contextlib.ExitStack()
    if options.cluster == "local":  # submitit's processes would outlive this one
        stack.enter_context(guard())
    return Jobs(jobs, slots, _POLL_SECONDS[options.cluster], stack)


class Jobs:
    """Submits jobs. One thread polls them all."""

    def __init__(self, jobs: Any, slots: int, poll_seconds: float, stack: contextlib.ExitStack) -> None:
        self.slots, self._stack = slots, stack
        self._jobs, self._poll_seconds = jobs, poll_seconds
        self._open: dict[Future[Any], Any] = {}
        self._changed = threading.Lock()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Queue a job."""
        future: Future[T] = Future()
        job = self._jobs.submit(work)
        with self._changed:
            self._open[future] = job
        return future

    def _watch(self) -> None:
        while not self._closed.wait(self._poll_seconds):
            with self._changed:
                ended = [future for future, job in self._open.items() if job.done()]
                jobs = [self._open.pop(future) for future in ended]
            for future, job in zip(ended, jobs, strict=True):
                _settle(future, job)

    def close(self, abandon: bool) -> None:
        """Cancel the jobs that run or wait. With `abandon`, wait until they have ended, at most ten seconds."""
        self._closed.set()
        with self._changed:
            jobs = list(self._open.values())
        for job in jobs:
            job.cancel()
        deadline = time.monotonic() + 10
        while abandon and any(not job.done() for job in jobs) and time.monotonic() < deadline:
            time.sleep(0.1)
        self._stack.close()


def _settle(future: Future[Any], job: Any) -> None:
    from submitit.core.utils import FailedJobError, UncompletedJobError

    try:
        future.set_result(job.result())
    except UncompletedJobError:
        future.set_exception(WorkerLost(f"its job {job.job_id} ended as {job.state}, see {job.paths.stderr}"))
    except FailedJobError as error:
        future.set_exception(RuntimeError(str(error).strip().splitlines()[-1]))
    except Exception as error:  # noqa: BLE001 - the future holds any exception
        future.set_exception(error)
