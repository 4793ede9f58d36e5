"""Runs blocks as tasks of a Ray cluster, or of a Ray that it starts on this machine.

The nodes must share the results folder.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli.base.errors import UsageError
from kerv_cli.lab.executors import THREAD_VARIABLES, Executor, RayOptions, WorkerLost
from kerv_cli.lab.executors.guard import guard

T = TypeVar("T")

_CONNECT_SECONDS = 5.0


def build(options: RayOptions, slots: int, threads: int, folder: Path) -> Executor:
    """Connect to the cluster, or start a Ray with as many processors as the slots need.

    Raises:
        UsageError: The cluster cannot be reached.
    """
    import ray

    _check_reachable(options.address)
    started: dict[str, Any] = {} if options.address else {"num_cpus": slots * threads, "include_dashboard": False}
    stack = contextlib.ExitStack()
    if not options.address:  # its agents would outlive this process
        stack.enter_context(guard())
    try:
        ray.init(address=options.address or "local", log_to_driver=False, logging_level="error", **started)
    except Exception as error:  # noqa: BLE001 - Ray raises a bare Exception on a slow machine
        stack.close()
        why = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise UsageError(f"the Ray cluster {options.address or 'of this machine'} cannot be reached: {why}") from None
    return Tasks(slots, threads, options.gpus, stack)


def _check_reachable(address: str) -> None:
    """Refuse a cluster at `host:port` or `ray://host:port` that does not answer. Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
    except OSError as error:
        raise UsageError(f"the Ray cluster {address} cannot be reached: {error.strerror or error}") from None


class Tasks:
    """Submits Ray tasks without Ray's retries, because `execute` decides about lost blocks."""

    def __init__(self, slots: int, threads: int, gpus: float, stack: contextlib.ExitStack) -> None:
        import ray

        self.slots, self._stack = slots, stack
        variables = dict.fromkeys(THREAD_VARIABLES, str(threads))
        options: dict[str, Any] = {"num_cpus": threads, "num_gpus": gpus, "max_retries": 0}
        self._call = ray.remote(_call).options(runtime_env={"env_vars": variables}, **options)
        self._open: list[Any] = []

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Start a task."""
        reference = self._call.remote(work)
        self._open.append(reference)
        outer: Future[T] = Future()
        reference.future().add_done_callback(lambda inner: _settle(outer, inner))
        return outer

    def close(self, abandon: bool) -> None:
        """Leave the cluster. With `abandon`, kill its tasks."""
        import ray

        if abandon:
            for reference in self._open:
                ray.cancel(reference, force=True)
        ray.shutdown()
        self._stack.close()


def _call(work: Callable[[], T]) -> T:
    return work()


def _settle(outer: Future[Any], inner: Future[Any]) -> None:
    from ray.exceptions import NodeDiedError, RayTaskError, WorkerCrashedError

    try:
        outer.set_result(inner.result())
    except RayTaskError as error:
        outer.set_exception(error.cause)
    except (WorkerCrashedError, NodeDiedError):
        outer.set_exception(WorkerLost("its worker process was lost"))
    except Exception as error:  # noqa: BLE001 - the future holds any exception
        outer.set_exception(error)
