"""Executor for Slurm clusters: each block of episodes is a job, submitted through submitit.

With `cluster: local` the jobs are processes on this machine, to try the options out. The nodes of a cluster must share
the results folder. If the cluster ends a job, the job counts as a lost worker.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli.base.errors import UsageError
from kerv_cli.lab.executors import THREAD_VARIABLES, Executor, SlurmOptions, WorkerLost, in_thread

T = TypeVar("T")


def build(options: SlurmOptions, slots: int, threads: int, folder: Path) -> Executor:
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
    return Jobs(jobs, slots)


class Jobs:
    """Executor that submits Slurm jobs."""

    def __init__(self, jobs: Any, slots: int) -> None:
        self.slots, self._jobs = slots, jobs
        self._submitted: list[Any] = []

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """Queue a function as a job, and return the future of its result.

        Raises:
            UsageError: Slurm refuses the job, for example because no node has that much memory.
        """
        from submitit.core.utils import FailedJobError

        try:
            job = self._jobs.submit(work)
        except FailedJobError as error:
            refusal = " ".join(str(error).split())
            raise UsageError(f"Slurm refuses the job: {refusal}: change runtime.executor_options") from None
        self._submitted.append(job)
        return in_thread(lambda: _result_of(job))

    def close(self, abandon: bool) -> None:
        """Cancel all jobs that run or wait."""
        for job in self._submitted:
            if not job.done():
                job.cancel(check=False)


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
