"""Worker processes of a sweep on this machine: `kerv work`, which end when the sweep ends, however it ends."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import IO

from kerv_cli.base.config import as_overrides
from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.lab.command import STORE
from kerv_cli.lab.events import BlockStarted
from kerv_cli.lab.progress import Progress
from kerv_cli.lab.queue import Queue, patiently

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Numerical libraries read these when they load, before torch.set_num_threads can be called."""
GPUS = "CUDA_VISIBLE_DEVICES"

MOST_STILLBORN = 3
"""So many workers in a row may die before they claim a block. Then the sweep ends."""
_POLL_SECONDS = 0.3


def thread_environment(threads: int) -> dict[str, str]:
    """Return the environment variables that limit a worker's CPU threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(threads))


def gpus_in_turn(device: str) -> list[str]:
    """Return the GPUs that workers get in turn, as values of CUDA_VISIBLE_DEVICES. Empty: workers see what is here.

    Args:
        device: Device of the settings. A GPU with a number, as in `cuda:1`, is the same for all workers.
    """
    if device != "cuda":
        return []
    visible = os.environ.get(GPUS)
    if visible is not None:
        return [one.strip() for one in visible.split(",") if one.strip()]
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]


def follow(queue: Queue, progress: Progress, tend: Callable[[], None]) -> None:
    """Wait until every block of a queue has ended, and show the progress of the processes that run them.

    Args:
        queue: The blocks.
        progress: Reads from the database what has ended.
        tend: Called at each look, to replace workers that ended.
    """
    shown: set[tuple[int, str]] = set()
    blocks = {tuple(block.episodes[0].key): block for block in progress.plan.blocks()}
    while not patiently(queue.is_empty):
        tend()
        for row in patiently(queue.claimed):
            block = blocks.get(tuple(row.episodes[0])) if row.episodes else None
            if (row.id, row.worker) not in shown and block is not None:
                shown.add((row.id, row.worker))
                progress.on_event(BlockStarted(block))
        patiently(progress.look)
        time.sleep(_POLL_SECONDS)


@dataclass
class _Worker:
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    gpu: str

    def last_line(self) -> str:
        """Return the last line that the worker has printed."""
        self.log.seek(0)
        lines = self.log.read().decode(errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "")


class LocalWorkers:
    """Processes of `kerv work`. Use it in a `with` statement, which ends them.

    Each reads from a pipe that nobody writes to. When this process ends, even if it is killed, the pipe is closed, and
    the workers end.

    Args:
        queue: The blocks that they run.
        number: Number of processes.
        threads: Number of CPU threads of each.
        gpus: Values of CUDA_VISIBLE_DEVICES, which the workers get in turn. Empty: the variable stays as it is.
    """

    def __init__(self, queue: Queue, number: int, threads: int, gpus: Sequence[str] = ()) -> None:
        self.queue, self.threads, self._stillborn = queue, threads, 0
        self._gpus = [gpus[at % len(gpus)] if gpus else "" for at in range(number)]
        self._workers: list[_Worker] = []

    def __enter__(self) -> LocalWorkers:
        self._workers = [self._started(gpu) for gpu in self._gpus]
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.wait()
            self._close(worker)
            with contextlib.suppress(StorageError):
                self.queue.lapse(worker.process.pid)

    def _started(self, gpu: str) -> _Worker:
        store, database = self.queue.store, self.queue.database
        words = as_overrides(study=store.name, results=str(database.results), run=self.queue.run)
        environment = {**os.environ, **thread_environment(self.threads), STORE: database.store}
        environment |= {GPUS: gpu} if gpu else {}
        log = tempfile.TemporaryFile()  # noqa: SIM115 - `_close` closes it
        process = subprocess.Popen(
            [sys.executable, "-m", "kerv_cli", "work", *words],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log,
        )  # fmt: skip
        return _Worker(process, log, gpu)

    @staticmethod
    def _close(worker: _Worker) -> None:
        if worker.process.stdin is not None:
            worker.process.stdin.close()
        worker.log.close()

    def tend(self) -> None:
        """Replace workers that were killed.

        Raises:
            KervError: A worker has ended with an error, or several in a row were killed before they claimed a block.
        """
        for at, worker in enumerate(self._workers):
            code = worker.process.poll()
            if code is None or code == 0:
                continue
            if code not in (130, 137) and code > 0:
                line = worker.last_line().removeprefix("kerv: ")
                raise KervError(f"a worker process ended: {line or f'exit code {code}'}")
            had_claims = patiently(lambda pid=worker.process.pid: self.queue.lapse(pid))  # type: ignore[misc]
            self._stillborn = 0 if had_claims else self._stillborn + 1
            if self._stillborn >= MOST_STILLBORN:
                raise KervError(f"{self._stillborn} worker processes were killed before they ran a block: "
                                "is there enough memory for them? try runtime.workers=1")  # fmt: skip
            self._close(worker)
            self._workers[at] = self._started(worker.gpu)
