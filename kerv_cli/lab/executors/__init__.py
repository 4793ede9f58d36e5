"""Executors run blocks, on this machine or on a cluster. Importing this module imports nothing heavy.

A new executor is a registered part: a class with the members of `Executor`, and a function `build(options, slots,
threads, folder)` that returns one. `options` are its settings from `runtime.executor_options`, `slots` is
`runtime.workers`, `threads` the number of threads of a process, `folder` a folder for its files, not yet created.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.limits import check_settings, number
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import add, find
from kerv_cli.base.settings import RuntimeSettings

T = TypeVar("T")

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Numerical libraries read these when they load, before torch.set_num_threads can be called."""


class WorkerLost(KervError):
    """A worker process ended before its result: killed, out of memory, or preempted by the cluster."""


class Executor(Protocol):
    """Runs functions in worker processes. `execute` decides which, and handles their results and failures."""

    @property
    def slots(self) -> int:
        """Number of functions that may run at the same time."""

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Start a picklable function. Its future holds the result or the exception; WorkerLost if the process died."""

    def close(self, abandon: bool) -> None:
        """End the workers. With `abandon`, kill those that work."""


def settle(
    future: Future[Any], result: Callable[[], Any], explained: Callable[[Exception], Exception] = lambda error: error
) -> None:
    """Set the result of a function, or its error as `explained` returns it."""
    try:
        future.set_result(result())
    except Exception as error:  # noqa: BLE001 - the future holds any exception
        future.set_exception(explained(error))


def check_executor(runtime: RuntimeSettings) -> Any:
    """Check and return the options of the chosen executor, without importing its package.

    Raises:
        UnknownName: There is no such executor.
        UsageError: An option is unknown or out of range, or a package is not installed.
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
    """Options of slurm, where a block is a job."""

    cluster: str = "slurm"  # slurm | local (submitit's own processes on this machine)
    partition: str = ""  # empty: the cluster's default
    minutes: int = number(120, 1, 100_000)  # longest time of a job
    memory_gb: int = number(8, 1, 100_000)
    gpus: int = number(0, 0, 1024)
    setup: list[str] = field(default_factory=list)  # shell lines before the job's Python starts


@dataclass
class RayOptions:
    """Options of ray, where a block is a task."""

    address: str = ""  # of a running cluster, e.g. auto or ray://host:10001; empty: start Ray on this machine
    gpus: float = number(0.0, 0, 1024)  # per block


add("executor", "local", "kerv_cli.lab.executors.local:build", LocalOptions)
add("executor", "slurm", "kerv_cli.lab.executors.clusters:build_slurm", SlurmOptions, package="submitit", extra="slurm")
add("executor", "ray", "kerv_cli.lab.executors.clusters:build_ray", RayOptions, package="ray", extra="ray")
