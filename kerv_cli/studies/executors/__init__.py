"""Where blocks run: on this machine, on a cluster. An executor is a registered part; nothing heavy is imported here.

A new one is a class with the three members of `Executor` and a `build(options, slots, threads, folder)` that returns
it: `options` its registered settings, filled from `runtime.executor_options`; `slots` is `runtime.workers`; `threads`
what torch and its libraries may use in each process; `folder` a place for files of its own, not yet created.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Protocol, TypeVar

from kerv_cli.errors import CheckpointError, KervError, UsageError
from kerv_cli.manifests import read
from kerv_cli.registry import find
from kerv_cli.settings import RuntimeSettings

T = TypeVar("T")

# Libraries read these when they load, before torch can be told its number.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class WorkerLost(KervError):
    """A worker ended before its result: killed, out of memory, taken away by the cluster."""


class Executor(Protocol):
    """Runs functions elsewhere. What they run, what they write and how failures are told is a sweep's business."""

    @property
    def slots(self) -> int:
        """How many functions may run at the same time."""

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Starts `work`, which is picklable. The future holds its result or what it raised; `WorkerLost` where its
        process ended before."""

    def close(self, abandon: bool) -> None:
        """Ends the workers. abandon: at once, whatever they do."""


def check_executor(runtime: RuntimeSettings) -> Any:
    """The options of the chosen executor, before anything heavy is imported.

    Raises:
        UnknownName: no such executor.
        UsageError: an option that it has not, a package that is not installed, fewer than one worker.
    """
    part = find("executor", runtime.executor)
    if runtime.workers < 1:
        raise UsageError(f"runtime.workers={runtime.workers}: at least 1")
    package = part.traits.get("package")
    if package is not None and importlib.util.find_spec(package) is None:
        raise UsageError(
            f"runtime.executor={part.name} needs the package {package}: pip install 'kerv[{part.traits['extra']}]'"
        )
    try:
        return read(part.settings, runtime.executor_options, "runtime.executor_options")
    except CheckpointError as error:
        raise UsageError(str(error).replace(" is damaged", "")) from None


def open_executor(runtime: RuntimeSettings, threads: int, folder: Path) -> Executor:
    """The chosen executor, ready.

    Raises:
        UsageError: as `check_executor`, and a cluster that cannot be reached.
    """
    options = check_executor(runtime)
    executor: Executor = find("executor", runtime.executor).built(options, runtime.workers, threads, folder)
    return executor
