"""Executors for clusters: blocks of episodes run as Slurm jobs, through submitit, or as tasks of a Ray cluster.

With `cluster: local` the jobs are processes on this machine. Without an address Ray starts on this machine. The nodes
of a cluster must share the results folder. If the cluster ends a job, the job counts as a lost worker.
"""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli.base.errors import UsageError
from kerv_cli.lab.executors import THREAD_VARIABLES, Executor, RayOptions, SlurmOptions, WorkerLost, settle

T = TypeVar("T")

_CONNECT_SECONDS = 5.0
_POLL_SECONDS = {"local": 0.2, "slurm": 5.0}
_MARK = "KERV_GUARD"
_GUARD = """
import os, select, signal, sys
def status(process):
    try:
        with open(f"/proc/{process}/stat") as file:
            fields = file.read().rpartition(")")[2].split()
        return int(fields[1]), int(fields[19])  # parent, start
    except OSError:  # it has ended
        return None, None

def look():
    every = {process: status(process) for process in map(int, filter(str.isdigit, os.listdir("/proc")))}
    before = 0
    while before < len(below):
        before = len(below)
        here = {parent for parent, start in below.items() if every.get(parent, (0, 0))[1] == start}
        below.update({process: start for process, (parent, start) in every.items() if parent in here})

below = {int(sys.argv[1]): status(sys.argv[1])[1]}  # process -> its start; descendants, also those of ended parents
look()
old = set(below)  # of what was there before: it stays
while not select.select([sys.stdin], [], [], 1)[0]:
    look()
def marked(process):
    try:
        with open(f"/proc/{process}/environ", "rb") as file:
            return mark in file.read()
    except OSError:
        return False

mark = sys.argv[2].encode()  # in the environment of what was started since the last look
look()
every = map(int, filter(str.isdigit, os.listdir("/proc")))
below.update({process: status(process)[1] for process in every if marked(process)})
for process, start in below.items():
    if process != os.getpid() and status(process)[1] == start and (process not in old or marked(process)):
        os.kill(process, signal.SIGKILL)
"""


@contextlib.contextmanager
def guard() -> Iterator[None]:
    """End all processes started inside this `with` block, and their children, when the block or this process ends.

    A separate guard process does this, so that it works even if this process is killed. It reads /proc (Linux).
    """
    mark = secrets.token_hex(8)
    command = [sys.executable, "-S", "-c", _GUARD, str(os.getpid()), mark]
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
    """Executor that submits Slurm jobs. A single thread checks which jobs have ended."""

    def __init__(self, jobs: Any, slots: int, poll_seconds: float, stack: contextlib.ExitStack) -> None:
        self.slots, self._stack = slots, stack
        self._jobs, self._poll_seconds = jobs, poll_seconds
        self._open: dict[Future[Any], Any] = {}
        self._changed = threading.Lock()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Queue a function as a job, and return the future of its result."""
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
                settle(future, job.result, functools.partial(_job_error, job))

    def close(self, abandon: bool) -> None:
        """Cancel all jobs that run or wait. With `abandon`, wait up to ten seconds until they have ended."""
        self._closed.set()
        with self._changed:
            jobs = list(self._open.values())
        for job in jobs:
            job.cancel()
        deadline = time.monotonic() + 10
        while abandon and any(not job.done() for job in jobs) and time.monotonic() < deadline:
            time.sleep(0.1)
        self._stack.close()


def _job_error(job: Any, error: Exception) -> Exception:
    from submitit.core.utils import FailedJobError, UncompletedJobError

    if isinstance(error, UncompletedJobError):
        return WorkerLost(f"its job {job.job_id} ended as {job.state}, see {job.paths.stderr}")
    return RuntimeError(str(error).strip().splitlines()[-1]) if isinstance(error, FailedJobError) else error


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
        self._open: list[Any] = []

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Start a function as a task, and return the future of its result."""
        reference = self._call.remote(work)
        self._open.append(reference)
        outer: Future[T] = Future()
        reference.future().add_done_callback(lambda inner: settle(outer, inner.result, _ray_error))
        return outer

    def close(self, abandon: bool) -> None:
        """Leave the cluster. With `abandon`, kill the tasks first."""
        import ray

        if abandon:
            for reference in self._open:
                ray.cancel(reference, force=True)
        ray.shutdown()
        self._stack.close()


def _call(work: Callable[[], T]) -> T:
    return work()


def _ray_error(error: Exception) -> Exception:
    from ray.exceptions import NodeDiedError, RayTaskError, WorkerCrashedError

    if isinstance(error, RayTaskError):
        return error.cause
    return WorkerLost("its worker process was lost") if isinstance(error, WorkerCrashedError | NodeDiedError) else error
