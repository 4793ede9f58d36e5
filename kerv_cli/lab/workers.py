"""Run a plan with workers: processes of `kerv work`, on this machine or wherever `runtime.launch` starts them.

Workers on this machine end when the sweep ends, even if the sweep is killed. Others end when no block is left.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import sqlalchemy as sa

from kerv_cli.base.config import as_overrides
from kerv_cli.base.durations import count
from kerv_cli.base.errors import Interrupted, KervError, StorageError, UsageError
from kerv_cli.episodes.runner import close_worlds
from kerv_cli.lab.command import STORE
from kerv_cli.lab.database import EPISODES
from kerv_cli.lab.queue import MOST_DEATHS, patiently
from kerv_cli.lab.runs import Run, bury
from kerv_cli.lab.store import ROLLOUT, counts_of
from kerv_cli.lab.study import Plan, is_elsewhere, save, withdraw
from kerv_cli.lab.work import (
    Counted,
    EpisodeRunner,
    Event,
    OnEvent,
    Outcome,
    Save,
    SettingFailed,
    Tend,
    follow,
)

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables with the number of CPU threads of numerical libraries.

The libraries read them when they load, before torch.set_num_threads can be called.
"""
GPUS = "CUDA_VISIBLE_DEVICES"


@contextlib.contextmanager
def begun(plan: Plan) -> Iterator[Run]:
    """Write the row of a command that runs a plan, for a `with` block.

    If the block raises an exception, the study's waiting episodes leave the queue.
    """
    study = plan.study
    with Run(study.database, study.kind, study.name, plan.command, len(plan.to_run), study.kind == ROLLOUT) as run:
        try:
            yield run
        except BaseException as error:
            done, total = len(plan.existing) + run.done, 0
            if not isinstance(error, UsageError):  # that is, the plan was not saved
                with contextlib.suppress(StorageError):
                    withdraw(plan, run.id)
                    done, total = counts_of(study)
            if not isinstance(error, KeyboardInterrupt):
                raise
            kept = f"{done} of {count(total or len(study.episodes), 'episode')} of {study.name}"
            again = "the same command" + (" without rerun=all" if plan.anew and study.kind != ROLLOUT else "")
            raise Interrupted(f"interrupted: {kept} are kept: run {again} to resume") from None
        finally:
            close_worlds()


def run(plan: Plan, on_event: OnEvent = lambda event: None, *, write: Save = lambda *_: None) -> Outcome:
    """Save a plan, and run its missing episodes. Each episode is in the database as soon as it ends.

    Args:
        plan: The plan.
        on_event: Called with each event, to show progress.
        write: Writes the recording (.rrd file) of an episode. The default writes nothing.
    """

    def forward(event: Event) -> None:
        if isinstance(event, SettingFailed) and plan.study.kind == ROLLOUT:
            raise event.error or KervError(event.reason)
        on_event(event)

    with begun(plan) as record:
        save(plan, record.id)
        with workers(plan, record.id) as tend:
            return follow(plan, record, tend, EpisodeRunner(plan.study.rollouts, write), forward)


def gpus_in_turn(plan: Plan) -> list[str]:
    """Return one value of CUDA_VISIBLE_DEVICES per GPU. Workers get these values in turn.

    Empty if some setting runs on another device than `cuda`. Then every worker sees the same GPUs as this process.
    """
    if {one.setting.settings["runtime"]["device"] for one in plan.to_run} != {"cuda"}:
        return []
    visible = os.environ.get(GPUS)
    if visible is not None:
        return [one.strip() for one in visible.split(",") if one.strip()]
    import torch

    return list(map(str, range(torch.cuda.device_count())))


@contextlib.contextmanager
def workers(plan: Plan, run: str, say: Callable[[str], object] = lambda line: None) -> Iterator[Tend]:
    """Start the workers of a plan for a `with` block.

    Args:
        plan: The plan, which is saved.
        run: Id of this command.
        say: Prints a line.

    Yields:
        A function for `follow`. It frees the episodes that killed workers had claimed, and replaces these workers.
    """
    runtime, study = plan.runtime, plan.study
    # a cluster's jobs find `kerv` where this process runs, also when its folder is not on the user's PATH
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    environment = os.environ | {STORE: study.database.store, "PATH": path}
    if plan.blocks and is_elsewhere(runtime):
        words = as_overrides(study=study.name, results=str(study.database.results.absolute()))
        if study.database.store and not sa.make_url(study.database.store).password:
            words.append(study.database.words[-1])
        line = shlex.join(["kerv", "work", *words])
        if runtime.launch:
            _launch(runtime.launch.replace("{command}", line).replace("{workers}", str(runtime.workers)), environment)
        else:
            say(f"start workers, as many as you like: {line}")
    if not plan.blocks or is_elsewhere(runtime) or runtime.workers == 1:
        yield lambda left: patiently(bury, study.database)
        return
    with _local_workers(plan, run, environment) as tend:
        yield tend


def _launch(line: str, environment: dict[str, str]) -> None:
    done = subprocess.run(line, shell=True, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())[-300:] or f"exit code {done.returncode}"
        raise KervError(f"runtime.launch: {line} failed: {said}")


@contextlib.contextmanager
def _local_workers(plan: Plan, run: str, environment: Mapping[str, str]) -> Iterator[Tend]:
    """Keep processes of `kerv work` running during a `with` block.

    Each reads from a pipe that nobody writes to. When this process ends, even if it is killed, the pipe is closed, and
    the workers end.
    """
    database, gpus = plan.study.database, gpus_in_turn(plan)
    words = as_overrides(study=plan.study.name, results=str(database.results.absolute()), run=run)
    threads = max(one.setting.settings["runtime"]["threads"] for one in plan.to_run)
    last = killed = 0

    def started(number: int) -> tuple[subprocess.Popen[bytes], IO[bytes]]:
        own = {**environment, **dict.fromkeys(THREAD_VARIABLES, str(threads))}
        own |= {GPUS: gpus[number % len(gpus)]} if gpus else {}
        log = tempfile.TemporaryFile()  # noqa: SIM115 - `_end` closes it
        streams: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": log}
        return subprocess.Popen([sys.executable, "-m", "kerv_cli", "work", *words], env=own, **streams), log

    def tend(left: int) -> None:
        nonlocal last, killed
        patiently(bury, database)
        for number, (process, log) in enumerate(running):
            code = process.poll()
            if code is None or code == 0:
                continue
            if code not in (130, 137) and code > 0:
                log.seek(0)
                line = log.read().decode(errors="replace").strip().rpartition("\n")[2].strip()
                raise KervError(f"a worker process ended: {line.removeprefix('kerv: ') or f'exit code {code}'}")
            last, killed = left, killed + 1 if left == last else 1
            # an episode in which MOST_DEATHS workers die fails, and is not left any more
            if killed > MOST_DEATHS * len(running):
                raise KervError(f"{killed} worker processes were killed and no episode has ended: "
                                "is there enough memory for them? try runtime.workers=1")  # fmt: skip
            _end(process, log)
            running[number] = started(number)

    running = list(map(started, range(min(plan.runtime.workers, len(plan.blocks)))))
    try:
        yield tend
    finally:
        for process, _ in running:
            process.kill()
        for one in running:
            _end(*one)
        with contextlib.suppress(KervError):
            bury(database)


def _end(process: subprocess.Popen[bytes], log: IO[bytes]) -> None:
    process.kill()
    process.communicate()
    log.close()


class TimeLeft:
    """Estimates how long the missing episodes of a plan take: first from stored episodes, then from the current pace.

    Args:
        plan: The plan.
        guess: Seconds per episode if none of the study's settings has a stored one.
    """

    def __init__(self, plan: Plan, guess: float) -> None:
        works = {setting.work for setting in plan.study.settings}
        query = sa.select(sa.func.avg(EPISODES.c.wall_seconds), sa.func.count(EPISODES.c.wall_seconds))
        with plan.study.database.reading() as connection:
            mean, stored = connection.execute(query.where(EPISODES.c.work.in_(works))).one()
        self.plan, self._began = plan, time.monotonic()
        self.seconds = len(plan.to_run) * (mean or guess) / max(1, min(plan.runtime.workers, len(plan.blocks)))
        self.source = (
            f"measured on {count(stored, 'stored episode')}" if stored else f"a guess of {guess:g} s per episode"
        )

    def see(self, event: Event) -> None:
        """Correct the estimate by the number of episodes that are left."""
        total = len(self.plan.to_run)
        if isinstance(event, Counted) and event.left < total:
            self.seconds = (time.monotonic() - self._began) * event.left / (total - event.left)
