"""Run cells here or over local processes: resume, isolate failures, tell what happens.

The process that runs a cell also writes it, so whatever dies loses at most the cells that were running.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from kerv_cli.decoding.record import EpisodeRecord
from kerv_cli.errors import CheckpointError, KervError, StorageError
from kerv_cli.provenance import git_commit, stamp
from kerv_cli.studies.events import (
    CellDone,
    CellFailed,
    CellReused,
    CellStarted,
    Failure,
    OnEvent,
    Outcome,
    SweepFinished,
    SweepStarted,
)
from kerv_cli.studies.plan import Cell, unique_cells
from kerv_cli.studies.store import StudyStore

RunCell = Callable[[Cell], list[EpisodeRecord]]
"""Runs a cell's episodes, one per seed, in order. Picklable; keeps what it loaded between calls in its module."""

# Libraries read these when they load, before run_cell can set torch's own number.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_WATCH_SECONDS = 1.0


@dataclass(frozen=True)
class _Result:
    """How a cell ended; plain values, because an exception may not survive pickling."""

    episodes: int = 0
    successes: int = 0
    seconds: float = 0.0
    reason: str = ""  # empty: complete
    reused: bool = False  # another sweep completed it meanwhile
    trace: str = ""
    storage: bool = False  # the disk refused: no other cell could be written either


@dataclass(frozen=True)
class _Job:
    """What a worker does with a cell; picklable."""

    run_cell: RunCell
    store: StudyStore
    status: dict[str, Any] = field(default_factory=dict)  # run id, workers, git commit

    def __call__(self, cell: Cell) -> _Result:
        started, clock = datetime.now(UTC).isoformat(timespec="seconds"), time.perf_counter()
        try:
            if self.store.has_cell(cell.id):
                return _Result(reused=True)
            records = self.run_cell(cell)
            seconds = time.perf_counter() - clock
            status = {**stamp(cell.settings["runtime"]["device"]), **self.status, "pid": os.getpid()}
            self.store.write_cell(cell, records, {**status, "seconds": seconds}, started)
        except Exception as error:  # noqa: BLE001 - one cell's failure of any kind must not end the others
            storage = isinstance(error, StorageError)
            return _Result(reason=one_line(error), trace=traceback.format_exc(), storage=storage)
        return _Result(len(records), sum(r.success for r in records), seconds)


def execute(
    cells: Sequence[Cell],
    run_cell: RunCell,
    store: StudyStore,
    workers: int = 1,
    on_event: OnEvent = lambda event: None,
) -> Outcome:
    """Runs the cells that are not complete yet; cells of one id run once.

    A cell that raises, or whose worker is killed, is reported as failed and the others go on. With one worker
    everything happens in this process. On KeyboardInterrupt the workers are stopped; completed cells stay.

    Raises:
        StorageError: the disk refused a result; going on would compute what cannot be kept.
        ValueError: fewer than one worker.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    clock = time.perf_counter()
    outcome = Outcome()
    store.clean_stale()
    todo, damaged = _split(cells, store, outcome)
    on_event(SweepStarted(len(todo) + len(damaged), len(outcome.reused), workers))
    for failure in damaged:
        _note(failure.cell, _Result(reason=failure.reason, trace=failure.reason), store, outcome, on_event)
    run = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"
    job = _Job(run_cell, store, {"run": run, "workers": workers, "git_commit": git_commit()})
    results = _here(todo, job, on_event) if workers == 1 else _over_processes(todo, job, workers, on_event)
    with contextlib.closing(results):  # stops the workers, whatever is raised below
        for cell, result in results:
            _note(cell, result, store, outcome, on_event)
    finished = Outcome(outcome.done, outcome.reused, outcome.failed, time.perf_counter() - clock)
    on_event(SweepFinished(finished))
    return finished


def _split(cells: Sequence[Cell], store: StudyStore, outcome: Outcome) -> tuple[list[Cell], list[Failure]]:
    """Cells to run and cells that are damaged; complete ones are added to the outcome."""
    todo: list[Cell] = []
    damaged: list[Failure] = []
    for cell in unique_cells(cells):
        try:
            (outcome.reused if store.has_cell(cell.id) else todo).append(cell)
        except CheckpointError as error:
            damaged.append(Failure(cell, str(error)))
    return todo, damaged


def _note(cell: Cell, result: _Result, store: StudyStore, outcome: Outcome, on_event: OnEvent) -> None:
    if result.storage:
        raise StorageError(result.reason)
    if result.reason:
        store.write_failure(cell.id, f"{cell.label} on {cell.task}\n\n{result.trace}")
        outcome.failed.append(Failure(cell, result.reason))
        on_event(CellFailed(cell, result.reason))
    elif result.reused:
        outcome.reused.append(cell)
        on_event(CellReused(cell))
    else:
        store.clear_failure(cell.id)
        outcome.done.append(cell)
        on_event(CellDone(cell, result.episodes, result.successes, result.seconds))


def _here(cells: Sequence[Cell], job: _Job, on_event: OnEvent) -> Generator[tuple[Cell, _Result], None, None]:
    for cell in cells:
        on_event(CellStarted(cell))
        yield cell, job(cell)


def _over_processes(
    cells: Sequence[Cell], job: _Job, workers: int, on_event: OnEvent
) -> Generator[tuple[Cell, _Result], None, None]:
    """Loky pools of one persistent worker each: when one dies, only its own cell is lost, and it is known which."""
    waiting = deque(cells)
    threads = max((cell.settings["runtime"]["threads"] for cell in cells), default=1)
    free = [_pool(threads) for _ in range(min(workers, len(cells)))]
    running: dict[Future[_Result], tuple[Any, Cell]] = {}
    finished = False
    try:
        while waiting or running:
            while waiting and free:
                pool, cell = free.pop(), waiting.popleft()
                on_event(CellStarted(cell))
                running[pool.submit(job, cell)] = (pool, cell)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                pool, cell = running.pop(future)
                result, alive = _result(future)
                if not alive:
                    pool.shutdown(wait=False, kill_workers=True)
                    pool = _pool(threads)
                free.append(pool)
                yield cell, result
        finished = True
    finally:
        for pool in [*free, *(pool for pool, _ in running.values())]:
            pool.shutdown(wait=True, kill_workers=not finished)


def _result(future: Future[_Result]) -> tuple[_Result, bool]:
    """A worker's result and whether the worker still lives."""
    from joblib.externals.loky.process_executor import BrokenProcessPool

    try:
        return future.result(), True
    except BrokenProcessPool as error:
        signals = re.findall(r"SIG[A-Z]+", str(error))
        how = f"killed by {signals[0]}" if signals else "lost"
        return _Result(reason=f"its worker process was {how}", trace=str(error)), False
    except Exception as error:  # noqa: BLE001 - the cell could not be sent or its result not be read
        return _Result(reason=one_line(error), trace=traceback.format_exc()), True


def _pool(threads: int) -> Any:
    """A pool of one worker, started when it gets its first cell."""
    from joblib.externals.loky import ProcessPoolExecutor

    return ProcessPoolExecutor(
        max_workers=1,
        initializer=_begin_worker,
        initargs=(os.getpid(),),
        env=dict.fromkeys(_THREAD_VARIABLES, str(threads)),
    )


def _begin_worker(parent: int) -> None:
    """Ctrl-C is the parent's business; and a worker whose parent was killed ends instead of running on unseen."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def one_line(error: BaseException) -> str:
    """An error for a summary: kerv's own message, or type, message and place of a foreign one."""
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text[:200]}{place}"


@dataclass(frozen=True)
class TimeEstimate:
    """How long a plan will take."""

    seconds: float
    to_run: int  # cells
    reused: int
    measured: bool  # False: a guess from `prior_seconds`
    source: str  # for people


def estimate(cells: Sequence[Cell], store: StudyStore, workers: int, prior_seconds: float) -> TimeEstimate:
    """Time for the cells that are not complete, from the mean wall seconds per episode of the study's stored cells.

    A label with stored cells uses its own mean, others the mean over all; `prior_seconds` per episode is the guess
    where nothing is stored. Workers are taken to scale perfectly.

    Raises:
        CheckpointError: a stored cell is damaged.
    """
    todo = [cell for cell in unique_cells(cells) if not store.has_cell(cell.id)]
    reused = len(unique_cells(cells)) - len(todo)
    known: dict[str, list[float]] = {}
    for folder in sorted(store.cells.glob("[0-9a-f]*")):
        stored = store.read_cell(folder.name)
        known.setdefault(stored.config["label"], []).extend(stored.episodes["wall_seconds"])
    every = [seconds for times in known.values() for seconds in times]
    prior = sum(every) / len(every) if every else prior_seconds
    means = {label: sum(times) / len(times) for label, times in known.items()}
    total = sum(len(cell.seeds) * means.get(cell.label, prior) for cell in todo)
    source = f"measured on {len(every)} stored episodes" if every else f"a guess of {prior_seconds:g} s per episode"
    return TimeEstimate(total / max(1, min(workers, len(todo))), len(todo), reused, bool(every), source)
