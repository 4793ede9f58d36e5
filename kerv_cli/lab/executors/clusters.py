"""Executors for clusters: blocks of episodes run as Slurm jobs, through submitit, or as tasks of a Ray cluster.

With `cluster: local` the jobs are processes on this machine. Without an address Ray starts on this machine. The nodes
of a cluster must share the results folder. If the cluster ends a job, the job counts as a lost worker.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli.base.errors import UsageError
from kerv_cli.lab.executors import THREAD_VARIABLES, Executor, RayOptions, SlurmOptions, WorkerLost, in_thread

T = TypeVar("T")

_CONNECT_SECONDS = 5.0
_MARK = "KERV_GUARD"
_GUARD = """
import os, signal, sys

def marked(process):
    try:
        with open(f"/proc/{process}/environ", "rb") as file:
            return sys.argv[1].encode() in file.read()
    except OSError:  # it has ended
        return False

sys.stdin.read()  # until the block or the process ends
while found := [int(one) for one in os.listdir("/proc") if one.isdigit() and int(one) != os.getpid() and marked(one)]:
    for process in found:
        try:
            os.kill(process, signal.SIGKILL)
        except ProcessLookupError:
            pass
"""


@contextlib.contextmanager
def guard() -> Iterator[None]:
    """End all processes started inside this `with` block, and their children, when the block or this process ends.

    A guard process does this, so that it works even if this process is killed. It finds the processes in /proc (Linux)
    by an environment variable, which they inherit.
    """
    mark = secrets.token_hex(8)
    command = [sys.executable, "-S", "-c", _GUARD, mark]
    with subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True):  # either end closes the pipe
        os.environ[_MARK] = mark
        try:
            yield
        finally:
            os.environ.pop(_MARK, None)


def build_slurm(options: SlurmOptions, slots: int, threads: int, folder: Path) -> Executor:
    """Return an executor that submits Slurm jobs.

    Args:
        options: Partition, time limit, memory, ….
        slots: Number of jobs that may run at the same time.
        threads: Number of processors per job.
        folder: Where submitit keeps its files.

    Raises:
        UsageError: This machine has no Slurm, or Slurm refuses the options.
    """
    import submitit

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
    return Jobs(jobs, slots, stack)


class Jobs:
    """Executor that submits Slurm jobs."""

    def __init__(self, jobs: Any, slots: int, stack: contextlib.ExitStack) -> None:
        self.slots, self._jobs, self._stack = slots, jobs, stack
        self._submitted: list[Any] = []

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Queue a function as a job, and return the future of its result."""
        job = self._jobs.submit(work)
        self._submitted.append(job)
        return in_thread(lambda: _result_of(job))

    def close(self, abandon: bool) -> None:
        """Cancel all jobs that run or wait."""
        for job in self._submitted:
            if not job.done():
                job.cancel(check=False)
        self._stack.close()


def _result_of(job: Any) -> Any:
    """Wait for a job, and return its result.

    Raises:
        WorkerLost: The cluster ended the job.
        RuntimeError: The function raised an exception that cannot be pickled.
    """
    from submitit.core.utils import FailedJobError, UncompletedJobError

    try:
        return job.result()
    except UncompletedJobError:
        raise WorkerLost(f"its job {job.job_id} ended as {job.state}, see {job.paths.stderr}") from None
    except FailedJobError as error:
        raise RuntimeError(str(error).strip().splitlines()[-1]) from None


def build_ray(options: RayOptions, slots: int, threads: int, folder: Path) -> Executor:
    """Connect to a Ray cluster, or start Ray on this machine if `options.address` is empty.

    Args:
        options: The cluster's address and GPUs per task.
        slots: Number of tasks that may run at the same time.
        threads: Number of processors per task.
        folder: Not used.

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
    """Refuse a cluster at `host:port` or `ray://host:port` that does not answer within seconds.

    Ray itself would try for minutes.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
    except OSError as error:
        raise UsageError(f"the Ray cluster {address} cannot be reached: {error.strerror or error}") from None


class Tasks:
    """Executor that submits Ray tasks. Ray's own retries are off, because `execute` decides about lost work."""

    def __init__(self, slots: int, threads: int, gpus: float, stack: contextlib.ExitStack) -> None:
        import ray

        self.slots, self._stack = slots, stack
        variables = dict.fromkeys(THREAD_VARIABLES, str(threads))
        options: dict[str, Any] = {"num_cpus": threads, "num_gpus": gpus, "max_retries": 0}
        self._call = ray.remote(_call).options(runtime_env={"env_vars": variables}, **options)
        self._submitted: list[Any] = []

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Start a function as a task, and return the future of its result."""
        reference = self._call.remote(work)
        self._submitted.append(reference)
        return in_thread(lambda: _got(reference))

    def close(self, abandon: bool) -> None:
        """Leave the cluster. With `abandon`, kill the tasks first."""
        import ray

        for reference in self._submitted if abandon else ():
            ray.cancel(reference, force=True)
        ray.shutdown()
        self._stack.close()


def _call(work: Callable[[], T]) -> T:
    return work()


def _got(reference: Any) -> Any:
    """Wait for a task, and return its result; raises WorkerLost if its process has ended."""
    import ray
    from ray.exceptions import NodeDiedError, RayTaskError, WorkerCrashedError

    try:
        return ray.get(reference)
    except RayTaskError as error:
        raise error.cause from None
    except (WorkerCrashedError, NodeDiedError):
        raise WorkerLost("its worker process was lost") from None
