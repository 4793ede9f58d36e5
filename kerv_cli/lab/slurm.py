"""Workers on a Slurm cluster: one array of jobs, each of which is `kerv work`.

The nodes must share the results folder, or the database must be on a server. The array outlives the sweep that
submitted it. A later sweep of the study finds it by its name.
"""

from __future__ import annotations

import hashlib
import shlex
import subprocess
import time
from pathlib import Path

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.files import storage_errors, visible
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.lab.progress import Progress
from kerv_cli.lab.queue import Queue
from kerv_cli.lab.workers import last_line, worker_command

_LOOK_SECONDS = 5.0
"""Seconds between two questions to Slurm."""


def _ask(program: str, *words: str, text: str = "", environment: dict[str, str] | None = None) -> str:
    """Run a program of Slurm, and return what it prints.

    Raises:
        UsageError: There is no such program, or it refuses.
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
    """The workers of a study on a cluster. If an earlier sweep's array still waits or runs, it is that one.

    Args:
        queue: The blocks.
        runtime: Number of workers, and what each needs.
        threads: Number of CPU threads of each.

    Raises:
        UsageError: This machine has no Slurm, or Slurm refuses the job.
    """

    def __init__(self, queue: Queue, runtime: RuntimeSettings, threads: int) -> None:
        self.queue, self.runtime, self.threads = queue, runtime, threads
        self.logs = queue.study.root / "jobs"
        database = hashlib.sha256(queue.database.shown.encode()).hexdigest()[:8]
        self.name = f"kerv-{queue.study.name}-{database}"
        self.id = self._running() or self._submitted()
        self._asked, self._done = time.monotonic(), -1

    def _running(self) -> str:
        """Return the id of the study's array that waits or runs. Empty if there is none."""
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
        flags = [f"--{key}={value}" for key, value in asked.items()]
        printed = _ask("sbatch", "--parsable", "--requeue", *flags, text=script, environment=environment)
        return printed.strip().partition(";")[0]

    def tend(self, progress: Progress) -> None:
        """Submit another array if all jobs have ended, for example because their time was over, but blocks are left.

        Raises:
            KervError: The jobs have ended without a single episode.
        """
        if time.monotonic() - self._asked < _LOOK_SECONDS:
            return
        self._asked, done = time.monotonic(), len(progress.outcome.done) + len(progress.outcome.failed)
        if self._running() or not self.queue.left()[0]:
            return
        if done <= self._done:
            raise KervError(f"job {self.id} of Slurm has ended without an episode: {self._last_line()}")
        self.id, self._done = self._submitted(), done

    def _last_line(self) -> str:
        """Return the last line of the newest log, or where the logs are."""
        logs: list[Path] = sorted(visible(self.logs), key=lambda path: path.stat().st_mtime)
        return (logs and last_line(logs[-1].read_text(errors="replace"))) or f"see {self.logs}"

    def cancel(self) -> None:
        """Cancel all jobs of the array."""
        _ask("scancel", self.id)
