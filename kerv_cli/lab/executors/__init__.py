"""Executors run groups of episodes in worker processes, here or on a cluster. This file imports nothing heavy.

A new executor is a registered part: a class with the members of `Executor`, and a function `build(options, slots,
threads, folder)` that returns an instance:

- options: The executor's settings, from `runtime.executor_options`.
- slots: Number of workers, from `runtime.workers`.
- threads: Number of CPU threads per worker.
- folder: A folder for the executor's own files. It does not exist yet.
"""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.limits import check_settings, choice, number
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import add, find
from kerv_cli.base.settings import RuntimeSettings

T = TypeVar("T")

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Numerical libraries read these when they load, before torch.set_num_threads can be called."""


class WorkerLost(KervError):
    """Raised if a worker process ended without a result: killed, out of memory, or preempted by the cluster."""


class Executor(Protocol):
    """Runs functions in worker processes. `execute` chooses the functions, and handles results and failures."""

    @property
    def slots(self) -> int:
        """Number of functions that may run at the same time."""

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Start a function that can be pickled.

        Returns:
            A future of its result or exception. The exception is WorkerLost if the process died.
        """

    def close(self, abandon: bool) -> None:
        """End the workers. With `abandon`, kill those that are still working."""


def settle(future: Future[T], work: Callable[[], T]) -> None:
    """Call a function, and complete a future with its result or its exception."""
    try:
        future.set_result(work())
    except Exception as error:  # noqa: BLE001 - the future holds any exception
        future.set_exception(error)


def in_thread(work: Callable[[], T]) -> Future[T]:
    """Call a function in a thread of its own, and return the future of its result."""
    future: Future[T] = Future()
    threading.Thread(target=settle, args=(future, work), daemon=True).start()
    return future


def check_executor(runtime: RuntimeSettings) -> Any:
    """Check the options of the chosen executor and return them, without importing the executor's package.

    Raises:
        UnknownName: The executor does not exist.
        UsageError: An option is unknown or out of range, or the executor's package is not installed.
    """
    part = find("executor", runtime.executor)
    check_settings(runtime, "runtime")
    package = part.traits.get("package")
    if package is not None and importlib.util.find_spec(package) is None:
        raise UsageError(
            f"runtime.executor={part.name} needs the package {package}: pip install 'kerv[{part.traits['extra']}]'"
        )
    try:
        return read(part.settings, runtime.executor_options, "runtime.executor_options")
    except CheckpointError as error:
        raise UsageError(str(error).replace(" is damaged", "")) from None


@dataclass
class LocalOptions:
    """The local executor has no options."""


@dataclass
class SlurmOptions:
    """Options of the Slurm executor, which runs each block of episodes as a job."""

    cluster: str = choice("slurm", "slurm", "local")  # local: submitit's own processes on this machine
    partition: str = ""  # empty: the cluster's default
    minutes: int = number(120, 1, 100_000)  # time limit of a job
    memory_gb: int = number(8, 1, 100_000)
    gpus: int = number(0, 0, 1024)
    setup: list[str] = field(default_factory=list)  # shell lines before the job's Python starts


add("executor", "local", "kerv_cli.lab.executors.local:build", LocalOptions)
add("executor", "slurm", "kerv_cli.lab.executors.slurm:build", SlurmOptions, package="submitit", extra="slurm")
