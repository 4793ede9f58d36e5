"""Runs a study's blocks through an executor: resumes, isolates failures, shares work with other sweeps, emits events.

The process that runs a block also writes its cells, so a crash loses at most the running cells. The settings of a block
take turns in it, episode by episode, and a cell is written after its last episode.
"""

from __future__ import annotations

import dataclasses
import math
import os
import secrets
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, Protocol, runtime_checkable

from kerv_cli.base.errors import CheckpointError, KervError, StorageError
from kerv_cli.base.leftovers import clean
from kerv_cli.base.provenance import git_commit, stamp
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab import events
from kerv_cli.lab.claims import claim, clean_void, is_claimed, note_running, release, running_cell
from kerv_cli.lab.code import code_hash
from kerv_cli.lab.executors import Executor, WorkerLost, check_executor, open_executor
from kerv_cli.lab.identity import ENGINE
from kerv_cli.lab.plan import Block, Cell, blocks_of
from kerv_cli.lab.rows import Circumstances
from kerv_cli.lab.store import StudyStore

_POLL_SECONDS = 1.0  # between two looks at blocks that another sweep computes

RunEpisode = Callable[[int], EpisodeRecord]
"""Runs the episode of a seed."""

Prepare = Callable[[Cell], RunEpisode]
"""Builds and warms up a cell's setting on its task. Picklable; loaded weights stay in its module between calls. One
that can run the cells of a batch is a `Together` too."""

Gauge = Callable[[str], float]
"""Seconds of a fixed workload on a device. Picklable."""


@runtime_checkable
class Together(Protocol):
    """Runs the episodes of several cells at once."""

    def together(self, cells: Sequence[Cell]) -> Iterator[tuple[Cell, int, EpisodeRecord | Exception]]:
        """Cells of one setting -> each episode as it ends: its cell, its seed, and its record or its error."""


@dataclass(frozen=True)
class CellResult:
    """The end of a cell, complete or failed; plain values, because an exception may not survive pickling."""

    episodes: int = 0
    successes: int = 0
    seconds: float = 0.0
    reason: str = ""  # empty: complete
    reused: bool = False  # another sweep completed it meanwhile
    trace: str = ""
    storage: bool = False  # the disk refused the cell: no other cell could be written either


Results = dict[str, CellResult]
"""Ends of a block's cells by id."""


def failed(error: BaseException) -> CellResult:
    """The result of a cell that raised `error`, inside an except clause."""
    return CellResult(reason=one_line(error), trace=traceback.format_exc(), storage=isinstance(error, StorageError))


def execute(
    cells: Sequence[Cell],
    prepare: Prepare,
    store: StudyStore,
    runtime: RuntimeSettings | None = None,
    on_event: events.OnEvent = lambda event: None,
    gauge: Gauge | None = None,
) -> events.Outcome:
    """Runs the cells that are not complete yet, block by block; cells of one id run once.

    A cell that raises, or whose worker is killed, is reported as failed and the rest of its block goes on. Cells that
    another sweep computes at the moment are waited for. With one local worker everything happens in this process. On
    KeyboardInterrupt the workers are stopped; completed cells stay.

    Raises:
        StorageError: the disk refused a result; further results could not be stored either.
        UsageError: the executor cannot be used.
    """
    runtime = runtime or RuntimeSettings()
    check_executor(runtime)
    clock = time.perf_counter()
    sweep = _Sweep(prepare, store, runtime, on_event, gauge)
    clean(store.cells)
    clean_void(store.claims)
    blocks, damaged = sweep.split(cells)
    threads = max((cell.settings["runtime"]["threads"] for cell in cells), default=1)
    executor = open_executor(runtime, threads, store.jobs) if blocks else None
    to_run = [cell for block in blocks for cell in block.cells]
    episodes = sum(len(cell.seeds) for cell in to_run)
    total = len(to_run) + len(damaged)
    on_event(events.SweepStarted(total, len(sweep.outcome.reused), runtime.workers, episodes))
    for cell, result in damaged:
        sweep.note(cell, result)
    if executor is not None:
        sweep.run(blocks, executor)
    outcome = dataclasses.replace(sweep.outcome, seconds=time.perf_counter() - clock)
    on_event(events.SweepFinished(outcome))
    return outcome


class _Sweep:
    """State of one call of `execute`."""

    def __init__(
        self,
        prepare: Prepare,
        store: StudyStore,
        runtime: RuntimeSettings,
        on_event: events.OnEvent,
        gauge: Gauge | None,
    ) -> None:
        self.prepare, self.store, self.on_event, self.gauge = prepare, store, on_event, gauge
        self.outcome = events.Outcome()
        self.run_id = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"
        self.workers = runtime.workers
        self.status = {
            "workers": runtime.workers,
            "executor": runtime.executor,
            "git_commit": git_commit(),
            "engine": ENGINE,
            "code": code_hash(),
        }
        self.waiting: deque[Block] = deque()
        self.elsewhere: list[Block] = []  # another sweep computes them
        self.running: dict[Future[Results | None], BlockRun] = {}

    def split(self, cells: Sequence[Cell]) -> tuple[list[Block], list[tuple[Cell, CellResult]]]:
        """Blocks of the cells to run, and the damaged cells; complete cells are added to the outcome."""
        damaged: dict[str, tuple[Cell, CellResult]] = {}
        for cell in (cell for block in blocks_of(cells) for cell in block.cells):
            try:
                if self.store.has_cell(cell.id):
                    self.outcome.reused.append(cell)
            except CheckpointError as error:
                damaged[cell.id] = cell, failed(error)
        settled = {*damaged, *(cell.id for cell in self.outcome.reused)}
        blocks = [block.without(settled) for block in blocks_of(cells, self.workers)]
        return [block for block in blocks if block is not None], list(damaged.values())

    def run(self, blocks: Sequence[Block], executor: Executor) -> None:
        """Keeps every slot busy until all blocks are settled."""
        self.waiting.extend(blocks)
        finished = False
        try:
            while self.waiting or self.running or self.elsewhere:
                while self.waiting and len(self.running) < executor.slots:
                    block = self.waiting.popleft()
                    name = f"{self.run_id}-{secrets.token_hex(4)}"
                    attempt = BlockRun(block, name, self.run_id, self.prepare, self.store, self.gauge, self.status)
                    self.on_event(events.BlockStarted(block))
                    self.running[executor.submit(attempt)] = attempt
                for future in wait(self.running, timeout=_POLL_SECONDS, return_when=FIRST_COMPLETED).done:
                    self._settle(self.running.pop(future), future)
                self._look_elsewhere()
            finished = True
        finally:
            executor.close(abandon=not finished)
            for attempt in self.running.values():
                release(self.store.claims, attempt.block.cells, attempt.name)

    def _settle(self, attempt: BlockRun, future: Future[Results | None]) -> None:
        block = attempt.block
        try:
            results = future.result()
        except WorkerLost as error:
            self._lost(attempt, failed(error))
            return
        except Exception as error:  # noqa: BLE001 - the block could not be sent or its result not be read
            self._note_all(block, dict.fromkeys((cell.id for cell in block.cells), failed(error)))
            return
        if results is None:
            self.elsewhere.append(block)
            self.on_event(events.BlockWaits(block))
        else:
            self._note_all(block, results)

    def _note_all(self, block: Block, results: Results) -> None:
        for cell in block.cells:
            if cell.id in results:
                self.note(cell, results[cell.id])

    def _lost(self, attempt: BlockRun, result: CellResult) -> None:
        """After a worker's end: the cell that ran has failed, complete cells are done, the block's others run again."""
        cells = attempt.block.cells
        last_cell = running_cell(self.store.claims, cells, attempt.name)
        release(self.store.claims, cells, attempt.name)
        results = {} if last_cell is None else {last_cell.id: result}
        for cell in cells:
            if last_cell is None:  # it ended before any cell ran: so would another attempt
                results[cell.id] = result
            elif self.store.has_cell(cell.id):
                status = self.store.status_of(cell.id)
                sums = status["episodes"], status["successes"], status["seconds"]
                results[cell.id] = CellResult(*sums, reused=status["run"] != self.run_id)
        self._note_all(attempt.block, results)
        rest = attempt.block.without(results)
        if rest is not None:
            self.waiting.append(rest)

    def _look_elsewhere(self) -> None:
        """When nothing else is left to do, queues the blocks that no other sweep computes any more."""
        if self.waiting or self.running or not self.elsewhere:
            return
        blocks, self.elsewhere = self.elsewhere, []
        for block in blocks:
            theirs = any(is_claimed(self.store.claims, cell) for cell in block.cells)
            (self.elsewhere if theirs else self.waiting).append(block)
        if not self.waiting:
            time.sleep(_POLL_SECONDS)

    def note(self, cell: Cell, result: CellResult) -> None:
        """Adds a cell's result to the outcome and emits its event."""
        if result.storage:
            raise StorageError(result.reason)
        if result.reason:
            self.store.write_failure(cell.id, f"{cell.label} on {cell.task}\n\n{result.trace}")
            self.outcome.failed.append(events.CellFailed(cell, result.reason))
            self.on_event(self.outcome.failed[-1])
        elif result.reused:
            self.outcome.reused.append(cell)
            self.on_event(events.CellReused(cell))
        else:
            self.store.clear_failure(cell.id)
            self.outcome.done.append(cell)
            self.on_event(events.CellDone(cell, result.episodes, result.successes, result.seconds))


@dataclass(frozen=True)
class BlockRun:
    """One attempt to run a block, the function that an executor calls. Picklable.

    name: unique among all attempts. run: id of the sweep. status: the sweep's entries in every cell's status.json.
    """

    block: Block
    name: str
    run: str
    prepare: Prepare
    store: StudyStore
    gauge: Gauge | None = None
    status: dict[str, Any] = field(default_factory=dict)

    def __call__(self) -> Results | None:
        """Results by cell id; None where another sweep computes one of the cells: nothing was run then."""
        try:
            if not claim(self.store.claims, self.block.cells, self.run, self.name):
                return None
        except StorageError as error:
            return {self.block.cells[0].id: failed(error)}
        try:
            return self._take_turns() if self.block.batch == 1 else self._together()
        finally:
            release(self.store.claims, self.block.cells, self.name)

    def _take_turns(self) -> Results:
        turns = [_Turn(cell, self) for cell in self.block.cells]
        results = {turn.cell.id: result for turn in turns if (result := _attempt(turn.prepare)) is not None}
        order = 0
        for seed in self.block.seeds:
            for turn in (turns[index] for index in self.block.order(seed)):
                if turn.cell.id in results:
                    continue
                result = _attempt(turn.take, seed, order)
                order += 1
                if result is not None:
                    results[turn.cell.id] = result
                    if result.storage:
                        return results
        return results

    def _together(self) -> Results:
        """Runs the cells of a batch; a cell is written as soon as its last episode has ended."""
        turns = {cell.id: _Turn(cell, self) for cell in self.block.cells if not self.store.has_cell(cell.id)}
        results = {cell.id: CellResult(reused=True) for cell in self.block.cells if cell.id not in turns}
        cells = [turn.cell for turn in turns.values()]
        try:
            if not isinstance(self.prepare, Together):
                raise TypeError(f"{type(self.prepare).__name__} runs one episode at a time, not {self.block.batch}")
            note_running(self.store.claims, self.block.cells[0], self.name)
            for order, (cell, _, end) in enumerate(self.prepare.together(cells) if cells else ()):
                if cell.id in results:
                    continue  # another of its episodes failed
                result = _attempt(turns[cell.id].add, end, order)
                if result is not None:
                    results[cell.id] = result
                    if result.storage:
                        return results
        except Exception as error:  # noqa: BLE001 - what the decodes have in common failed
            results = dict.fromkeys(turns, failed(error)) | results
        return results


def _attempt(step: Callable[..., CellResult | None], *arguments: Any) -> CellResult | None:
    """The step's result; an error is the cell's result."""
    try:
        return step(*arguments)
    except Exception as error:  # noqa: BLE001 - one setting's failure of any kind must not end the others
        return failed(error)


class _Turn:
    """One cell's part in a block. Its methods return the cell's result as soon as it is complete, or raise."""

    def __init__(self, cell: Cell, work: BlockRun) -> None:
        self.cell, self.work = cell, work
        self.device = str(cell.settings["runtime"]["device"])
        self.episodes: list[tuple[EpisodeRecord, Circumstances]] = []
        self.seconds = 0.0

    def prepare(self) -> CellResult | None:
        """Builds the setting, unless the cell is complete."""
        clock = time.perf_counter()
        if self.work.store.has_cell(self.cell.id):
            return CellResult(reused=True)
        note_running(self.work.store.claims, self.cell, self.work.name)
        self.run_episode = self.work.prepare(self.cell)
        self.seconds += time.perf_counter() - clock
        return None

    def take(self, seed: int, order: int) -> CellResult | None:
        """Runs one episode; writes the cell after its last one."""
        note_running(self.work.store.claims, self.cell, self.work.name)
        started = datetime.now(UTC)
        load = self.work.gauge(self.device) if self.work.gauge is not None else math.nan
        clock = time.perf_counter()
        record = self.run_episode(seed)
        return self._keep(record, order, started, load, time.perf_counter() - clock)

    def add(self, end: EpisodeRecord | Exception, order: int) -> CellResult | None:
        """Takes an episode of a batch, in any order of seeds; writes the cell after its last one."""
        note_running(self.work.store.claims, self.cell, self.work.name)
        if isinstance(end, Exception):
            raise end
        started = datetime.now(UTC) - timedelta(seconds=end.wall_seconds)
        return self._keep(end, order, started, math.nan, end.wall_seconds)

    def _keep(
        self, record: EpisodeRecord, order: int, started: datetime, load: float, seconds: float
    ) -> CellResult | None:
        at = Circumstances(self.work.name, order, started.isoformat(timespec="milliseconds"), load)
        self.episodes.append((record, at))
        self.seconds += seconds
        if len(self.episodes) < len(self.cell.seeds):
            return None
        status = {**stamp(self.device), **self.work.status, "run": self.work.run, "pid": os.getpid()}
        status |= {"seconds": self.seconds}
        records, circumstances = zip(*sorted(self.episodes, key=lambda episode: episode[0].seed), strict=True)
        if not self.work.store.write_cell(self.cell, records, status, circumstances):
            return CellResult(reused=True)
        return CellResult(len(records), sum(record.success for record in records), self.seconds)


def one_line(error: BaseException) -> str:
    """An error in one line: the message of a KervError; type, message and line of the source of any other."""
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    line = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text[:200]}{line}"
