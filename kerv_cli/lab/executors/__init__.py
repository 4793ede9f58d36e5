"""Executors run blocks, on this machine or on a cluster. Each is a registered part; nothing heavy is imported here.

A new one is a class with the three members of `Executor` and a `build(options, slots, threads, folder)` that returns
it. options: its registered settings, filled from `runtime.executor_options`. slots: `runtime.workers`. threads: for
torch and its libraries in each process. folder: for files of its own, not yet created.
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

# Numerical libraries read these when they load, before torch.set_num_threads can be called.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class WorkerLost(KervError):
    """A worker process ended before its result: killed, out of memory, or preempted by the cluster."""


class Executor(Protocol):
    """Runs functions in worker processes; `execute` decides which, and handles their results and failures."""

    @property
    def slots(self) -> int:
        """How many functions may run at the same time."""

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Starts `work`, a picklable function. The future holds its result or exception, `WorkerLost` if its process
        ended before."""

    def close(self, abandon: bool) -> None:
        """Ends the workers. abandon: kill them while they work."""


def check_executor(runtime: RuntimeSettings) -> Any:
    """The options of the chosen executor, checked without importing its package.

    Raises:
        UnknownName: no such executor.
        UsageError: an unknown option, a package that is not installed, a setting out of range.
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
    """The local executor has no `runtime.executor_options`."""


@dataclass
class SlurmOptions:
    """`runtime.executor_options` of slurm: a block is a job."""

    cluster: str = "slurm"  # slurm | local (submitit's own processes on this machine)
    partition: str = ""  # empty: the cluster's default
    minutes: int = number(120, 1, 100_000)  # longest time of a job
    memory_gb: int = number(8, 1, 100_000)
    gpus: int = number(0, 0, 1024)
    setup: list[str] = field(default_factory=list)  # shell lines before the job's Python starts


@dataclass
class RayOptions:
    """`runtime.executor_options` of ray: a block is a task."""

    address: str = ""  # of a running cluster, e.g. auto or ray://host:10001; empty: a Ray of its own on this machine
    gpus: float = number(0.0, 0, 1024)  # per block


add("executor", "local", "kerv_cli.lab.executors.local:build", LocalOptions)
add("executor", "slurm", "kerv_cli.lab.executors.slurm:build", SlurmOptions, package="submitit", extra="slurm")
add("executor", "ray", "kerv_cli.lab.executors.ray:build", RayOptions, package="ray", extra="ray")
