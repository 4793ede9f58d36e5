"""Workers of a sweep, which are processes of `kerv work`: on this machine, or on a Slurm cluster.

Workers on this machine end when the sweep ends, even if the sweep is killed. Workers on a cluster are one array of
jobs, which can outlive the sweep. A later sweep of the same study finds the array by its name. The nodes must share
the results folder, or the database must be on a server.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from kerv_cli.base.config import as_overrides
from kerv_cli.base.durations import count
from kerv_cli.base.errors import KervError, StorageError, UsageError
from kerv_cli.base.files import storage_errors, visible
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.lab.command import STORE
from kerv_cli.lab.store import Study
from kerv_cli.lab.work import Queue, patiently

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables with the number of CPU threads of numerical libraries.

The libraries read them when they load, before torch.set_num_threads can be called.
"""
GPUS = "CUDA_VISIBLE_DEVICES"

MOST_STILLBORN = 3
"""After this many workers in a row have died before they claimed a block, the sweep ends."""
_LOOK_SECONDS = 5.0
"""Seconds between two questions to Slurm."""


def worker_command(queue: Queue, threads: int, **settings: str) -> tuple[list[str], dict[str, str]]:
    """Return the command line and the environment variables that start a worker for a queue's study.

    Args:
        queue: The queue, which names the study and the database.
        threads: Number of CPU threads.
        **settings: Further settings of `kerv work`.
    """
    results = str(queue.database.results.absolute())
    words = as_overrides(study=queue.study.name, results=results, **settings)
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(threads)) | {STORE: queue.database.store}
    return [sys.executable, "-m", "kerv_cli", "work", *words], environment


def last_line(text: str) -> str:
    """Return the last line of `text` that is not blank. Empty if every line is blank."""
    return text.strip().rpartition("\n")[2].strip()


def gpus_in_turn(device: str) -> list[str]:
    """Return one value of CUDA_VISIBLE_DEVICES per GPU. Workers get these values in turn.

    If the list is empty, the workers see the same GPUs as this process.

    Args:
        device: Device of the settings. If it is no GPU, or a GPU with a number as in `cuda:1`, the list is empty.
    """
    if device != "cuda":
        return []
    visible = os.environ.get(GPUS)
    if visible is not None:
        return [one.strip() for one in visible.split(",") if one.strip()]
    import torch

    return list(map(str, range(torch.cuda.device_count())))


def disturbances(study: Study) -> list[str]:
    """Return sentences about what will disturb the measured times: workers that share a GPU or the CPU's memory."""
    runtime = study.runtime
    if runtime.workers == 1 or runtime.executor != "local" or all(block.batch > 1 for block in study.blocks):
        return []
    gpus = len(gpus_in_turn(study.device))
    if study.device != "cuda":
        shared = "share this machine's memory: each needs a core and a memory channel of its own"
    elif runtime.workers > gpus:
        shared = f"share {count(gpus, 'GPU')}"
    else:
        return []
    return [f"{runtime.workers} workers measure times and {shared} (docs/scale.md)"]


@dataclass
class _Worker:
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    gpu: str

    def last_line(self) -> str:
        """Return the last line that the worker has printed."""
        self.log.seek(0)
        return last_line(self.log.read().decode(errors="replace"))


class LocalWorkers:
    """Processes of `kerv work`. Use it in a `with` statement, which starts and ends them.

    Each worker reads from a pipe that nobody writes to. When this process ends, even if it is killed, the pipe is
    closed, and the workers end.

    Args:
        queue: The blocks that the workers run.
        number: Number of workers.
        threads: Number of CPU threads per worker.
        gpus: Values of CUDA_VISIBLE_DEVICES, which the workers get in turn. If empty, the variable stays as it is.
    """

    def __init__(self, queue: Queue, number: int, threads: int, gpus: Sequence[str] = ()) -> None:
        self.queue, self.threads, self._stillborn = queue, threads, 0
        self._gpus = list(itertools.islice(itertools.cycle(gpus or [""]), number))
        self._workers: list[_Worker] = []

    def __enter__(self) -> LocalWorkers:
        self._workers = list(map(self._started, self._gpus))
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
        words, environment = worker_command(self.queue, self.threads, run=self.queue.run)
        environment |= {GPUS: gpu} if gpu else {}
        log = tempfile.TemporaryFile()  # noqa: SIM115 - `_close` closes it
        streams: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": log}
        return _Worker(subprocess.Popen(words, env=environment, **streams), log, gpu)

    @staticmethod
    def _close(worker: _Worker) -> None:
        if worker.process.stdin is not None:
            worker.process.stdin.close()
        worker.log.close()

    def tend(self) -> None:
        """Replace workers that were killed.

        Raises:
            KervError: A worker has ended with an error, or MOST_STILLBORN in a row were killed before they claimed a
                block.
        """
        for at, worker in enumerate(self._workers):
            code = worker.process.poll()
            if code is None or code == 0:
                continue
            if code not in (130, 137) and code > 0:
                line = worker.last_line().removeprefix("kerv: ")
                raise KervError(f"a worker process ended: {line or f'exit code {code}'}")
            had_claims = patiently(self.queue.lapse, worker.process.pid)
            self._stillborn = 0 if had_claims else self._stillborn + 1
            if self._stillborn >= MOST_STILLBORN:
                raise KervError(f"{self._stillborn} worker processes were killed before they ran a block: "
                                "is there enough memory for them? try runtime.workers=1")  # fmt: skip
            self._close(worker)
            self._workers[at] = self._started(worker.gpu)


def _ask(program: str, *words: str, text: str = "", environment: dict[str, str] | None = None) -> str:
    """Run a program of Slurm, and return what it prints.

    Raises:
        UsageError: There is no such program, it does not answer within 60 s, or it refuses.
    """
    try:
        run = subprocess.run(
            [program, *words], input=text, capture_output=True, text=True, timeout=60, env=environment, check=False
        )
    except FileNotFoundError:
        raise UsageError(f"Slurm cannot be used from here: there is no program {program}") from None
    except subprocess.TimeoutExpired:
        raise UsageError(f"Slurm cannot be used from here: {program} does not answer") from None
    if run.returncode:
        refusal = " ".join((run.stderr or run.stdout).split())
        raise UsageError(f"Slurm refuses: {refusal}: change runtime.executor_options")
    return run.stdout


class Array:
    """The workers of a study on a cluster: an array of Slurm jobs. Ctrl-C in the `with` statement cancels the jobs.

    An array from an earlier sweep of the study is used if it still waits or runs. Otherwise a new one is submitted.

    Args:
        queue: The blocks.
        runtime: Number of workers, and the resources that each worker needs.
        threads: Number of CPU threads per worker.

    Raises:
        UsageError: This machine has no Slurm, or Slurm refuses the job.
        StorageError: The folder of the workers' logs cannot be made.
    """

    def __init__(self, queue: Queue, runtime: RuntimeSettings, threads: int) -> None:
        self.queue, self.runtime, self.threads = queue, runtime, threads
        self.logs = queue.study.root / "jobs"
        database = hashlib.sha256(queue.database.shown.encode()).hexdigest()[:8]
        self.name = f"kerv-{queue.study.name}-{database}"
        self.id = self._running() or self._submitted()
        self._asked, self._ended = time.monotonic(), -1

    def __enter__(self) -> Array:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is KeyboardInterrupt:
            with contextlib.suppress(KervError):
                _ask("scancel", self.id)

    def _running(self) -> str:
        """Return the id of this study's array if it waits or runs. Empty if there is no such array."""
        found = _ask("squeue", "--noheader", "--me", f"--name={self.name}", "--format=%F").split()
        return found[0] if found else ""

    def _submitted(self) -> str:
        """Submit an array, and return its id."""
        runtime, options = self.runtime, self.runtime.executor_options
        words, environment = worker_command(self.queue, self.threads)
        with storage_errors(self.logs):
            self.logs.mkdir(parents=True, exist_ok=True)
        asked = {
            "job-name": self.name,
            "array": f"0-{runtime.workers - 1}",
            "output": f"{self.logs.absolute()}/%A_%a.log",
            "open-mode": "append",
            "time": options.minutes,
            "cpus-per-task": self.threads,
            "mem": f"{options.memory_gb}G",
            **({"gpus": options.gpus} if options.gpus else {}),
            **({"partition": options.partition} if options.partition else {}),
        }
        script = "\n".join(["#!/bin/sh", *options.setup, f"exec {shlex.join(words)}", ""])
        flags = list(map("--{}={}".format, asked, asked.values()))
        printed = _ask("sbatch", "--parsable", "--requeue", *flags, text=script, environment=environment)
        return printed.strip().partition(";")[0]

    def tend(self, ended: int) -> None:
        """Submit another array if all jobs have ended but some episodes are left, for example at a time limit.

        Args:
            ended: Number of episodes and settings that have ended or failed so far.

        Raises:
            KervError: All jobs of an array from this method have ended, and no episode or setting ended meanwhile.
        """
        if time.monotonic() - self._asked < _LOOK_SECONDS:
            return
        self._asked = time.monotonic()
        if self._running() or not self.queue.left()[0]:
            return
        if ended <= self._ended:
            raise KervError(f"job {self.id} of Slurm has ended without an episode: {self._last_line()}")
        self.id, self._ended = self._submitted(), ended

    def _last_line(self) -> str:
        """Return the last line of the newest log. If there is none, return a text that says where the logs are."""
        logs: list[Path] = sorted(visible(self.logs), key=lambda path: path.stat().st_mtime)
        return (logs and last_line(logs[-1].read_text(errors="replace"))) or f"see {self.logs}"
