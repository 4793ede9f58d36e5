"""Workers of a sweep, which are processes of `kerv work`: on this machine, or wherever a command starts them.

Workers on this machine end when the sweep ends, even if the sweep is killed. Others end when no block is left.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import sqlalchemy as sa

from kerv_cli.base.config import as_overrides
from kerv_cli.base.errors import KervError
from kerv_cli.lab.command import STORE
from kerv_cli.lab.database import PLANNED, STUDIES, UNFINISHED, WANTED, Database
from kerv_cli.lab.presence import bury
from kerv_cli.lab.queue import patiently
from kerv_cli.lab.study import Plan

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables with the number of CPU threads of numerical libraries.

The libraries read them when they load, before torch.set_num_threads can be called.
"""
GPUS = "CUDA_VISIBLE_DEVICES"

MOST_STILLBORN = 3
"""After this many workers in a row have died before they claimed a block, the sweep ends."""


def work_command(database: Database, study: str, **settings: str) -> str:
    """Return the shell command that starts a worker for a study. It names no password."""
    words = as_overrides(study=study, results=str(database.results.absolute()), **settings)
    if database.store and not sa.make_url(database.store).password:
        words.append(f"store={database.shown}")
    return shlex.join(["kerv", "work", *words])


def gpus_in_turn(plan: Plan) -> list[str]:
    """Return one value of CUDA_VISIBLE_DEVICES per GPU. Workers get these values in turn.

    Empty if the workers see the same GPUs as this process: not all settings run on `cuda`, the GPU without a number.
    """
    if {one.setting.settings["runtime"]["device"] for one in plan.to_run} != {"cuda"}:
        return []
    visible = os.environ.get(GPUS)
    if visible is not None:
        return [one.strip() for one in visible.split(",") if one.strip()]
    import torch

    return list(map(str, range(torch.cuda.device_count())))


@contextlib.contextmanager
def workers(plan: Plan, run: str, say: Callable[[str], object] = lambda line: None) -> Iterator[Callable[[], object]]:
    """Start the workers of a plan for a `with` block.

    Args:
        plan: The plan, which is saved.
        run: Id of this command.
        say: Prints a line.

    Yields:
        A function to call again and again. It frees what killed workers had claimed, and replaces them.
    """
    runtime, study = plan.runtime, plan.study
    # a cluster's jobs find `kerv` where this process runs, also when its folder is not on the user's PATH
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    environment = os.environ | {STORE: study.database.store, "PATH": path}
    if plan.blocks and plan.is_elsewhere:
        line = work_command(study.database, study.name)
        if runtime.launch:
            _launch(runtime.launch.replace("{command}", line).replace("{workers}", str(runtime.workers)), environment)
        else:
            say(f"start workers, as many as you like: {line}")
    if not plan.blocks or plan.is_elsewhere or runtime.workers == 1:
        yield lambda: patiently(bury, study.database)
        return
    threads = max((one.setting.settings["runtime"]["threads"] for one in plan.to_run), default=1)
    environment |= dict.fromkeys(THREAD_VARIABLES, str(threads))
    number = min(runtime.workers, len(plan.blocks))
    with LocalWorkers(study.database, study.name, run, number, environment, gpus_in_turn(plan)) as local:
        yield local.tend


def _launch(line: str, environment: dict[str, str]) -> None:
    done = subprocess.run(line, shell=True, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())[-300:] or f"exit code {done.returncode}"
        raise KervError(f"runtime.launch: {line} failed: {said}")


def last_line(text: str) -> str:
    return text.strip().rpartition("\n")[2].strip()


@dataclass
class _Worker:
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    gpu: str

    def last_line(self) -> str:
        self.log.seek(0)
        return last_line(self.log.read().decode(errors="replace"))


class LocalWorkers:
    """Processes of `kerv work`. Use it in a `with` statement, which starts and ends them.

    Each worker reads from a pipe that nobody writes to. When this process ends, even if it is killed, the pipe is
    closed, and the workers end.

    Args:
        database: The database.
        study: Name of the study.
        run: Id of the command.
        number: Number of workers.
        environment: Environment variables.
        gpus: Values of CUDA_VISIBLE_DEVICES, which the workers get in turn. If empty, the variable stays as it is.
    """

    def __init__(
        self,
        database: Database,
        study: str,
        run: str,
        number: int,
        environment: dict[str, str],
        gpus: Sequence[str] = (),
    ) -> None:
        self.database, self.study, self._environment = database, study, environment
        self._stillborn, self._progress = 0, (0, 0)
        words = as_overrides(study=study, results=str(database.results.absolute()), run=run)
        self._words = [sys.executable, "-m", "kerv_cli", "work", *words]
        self._gpus = list(itertools.islice(itertools.cycle(gpus or [""]), number))
        self._workers: list[_Worker] = []

    def __enter__(self) -> LocalWorkers:
        self._progress = self._read_progress()
        self._workers = list(map(self._started, self._gpus))
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.wait()
            self._close(worker)
        with contextlib.suppress(KervError):
            bury(self.database)

    def _read_progress(self) -> tuple[int, int]:
        begun = sa.func.coalesce(sa.func.sum(WANTED.c.attempts), 0)
        query = sa.select(sa.func.count(), begun).select_from(PLANNED)
        with self.database.reading() as connection:
            left, number = connection.execute(query.where(STUDIES.c.name == self.study, UNFINISHED)).one()
        return int(left), int(number)

    def _started(self, gpu: str) -> _Worker:
        environment = self._environment | ({GPUS: gpu} if gpu else {})
        log = tempfile.TemporaryFile()  # noqa: SIM115 - `_close` closes it
        streams: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": log}
        return _Worker(subprocess.Popen(self._words, env=environment, **streams), log, gpu)

    @staticmethod
    def _close(worker: _Worker) -> None:
        if worker.process.stdin is not None:
            worker.process.stdin.close()
        worker.log.close()

    def tend(self) -> None:
        """Free what killed workers had claimed, and replace them."""
        patiently(bury, self.database)
        for at, worker in enumerate(self._workers):
            code = worker.process.poll()
            if code is None or code == 0:
                continue
            if code not in (130, 137) and code > 0:
                line = worker.last_line().removeprefix("kerv: ")
                raise KervError(f"a worker process ended: {line or f'exit code {code}'}")
            before, self._progress = self._progress, patiently(self._read_progress)
            self._stillborn = self._stillborn + 1 if before == self._progress else 0
            if self._stillborn >= MOST_STILLBORN:
                raise KervError(f"{self._stillborn} worker processes were killed before they ran a block: "
                                "is there enough memory for them? try runtime.workers=1")  # fmt: skip
            self._close(worker)
            self._workers[at] = self._started(worker.gpu)
