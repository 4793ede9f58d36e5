"""Runs a study's blocks through an executor: resumes, isolates failures, shares work with other sweeps, emits events.

The process that runs a block also writes its cells, so a crash loses at most the running cells. The settings of a block
take turns in it, episode by episode, and a cell is written after its last episode.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
import secrets
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from kerv_cli.base.errors import CheckpointError, KervError, StorageError
from kerv_cli.base.leftovers import clean
from kerv_cli.base.provenance import git_commit, stamp
from kerv_cli.base.registry import find
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab.claims import claim, clean_void, episodes_ended, is_claimed, note_running, release, running_cell
from kerv_cli.lab.code import code_hash
from kerv_cli.lab.events import BlockRuns, BlockStarted, BlockWaits, CellEnd, OnEvent, Outcome, SweepStarted
from kerv_cli.lab.executors import Executor, WorkerLost, check_executor
from kerv_cli.lab.identity import ENGINE
from kerv_cli.lab.plan import Block, Cell, blocks_of
from kerv_cli.lab.rows import Circumstances
from kerv_cli.lab.store import StudyStore, new_run_id

_POLL_SECONDS = 1.0  # between two looks at blocks that another process computes

RunEpisode = Callable[[int], EpisodeRecord]
"""Runs the episode of a seed."""

Prepare = Callable[[Cell], RunEpisode]
"""Builds and warms up a cell's setting on its task. Picklable; loaded weights stay in its module between calls. For
cells of a batch it has a method too, `CellRunner.together`."""

Ends = dict[str, CellEnd]
"""Ends of a block's cells by id."""

Step = tuple[Cell, Callable[[], CellEnd | None]]
"""A cell, and what is to be done for it next: the end of the cell where that completes it."""


def failure(cell: Cell, error: Exception) -> CellEnd:
    """The end of a cell by an error, inside the except clause that caught it."""
    trace = traceback.format_exc()
    kept = error.with_traceback(None) if isinstance(error, KervError) else None  # frames hold weights
    return CellEnd(cell, reason=one_line(error), trace=trace, error=kept)


def execute(
    cells: Sequence[Cell],
    prepare: Prepare,
    store: StudyStore,
    runtime: RuntimeSettings | None = None,
    on_event: OnEvent = lambda event: None,
) -> Outcome:
    """Runs the cells that are not complete yet, block by block; cells of one id run once.

    A cell that raises, or whose worker is killed, is reported as failed and the rest of its block goes on. Cells that
    another sweep computes at the moment are waited for. With one local worker everything happens in this process. On
    KeyboardInterrupt the workers are stopped; completed cells stay.

    Raises:
        StorageError: the disk refused a result; further results could not be stored either.
        UsageError: the executor cannot be used.
    """
    return _Sweep(prepare, store, runtime or RuntimeSettings(), on_event).run(cells)


class _Sweep:
    """State of one call of `execute`."""

    def __init__(self, prepare: Prepare, store: StudyStore, runtime: RuntimeSettings, on_event: OnEvent) -> None:
        self.prepare, self.store, self.runtime, self.on_event = prepare, store, runtime, on_event
        self.options = check_executor(runtime)
        self.outcome = Outcome()
        self.run_id = new_run_id()
        self.status = {
            "workers": runtime.workers,
            "executor": runtime.executor,
            "git_commit": git_commit(),
            "engine": ENGINE,
            "code": code_hash(),
        }
        self.waiting: deque[Block] = deque()
        self.elsewhere: list[Block] = []  # another sweep computes them
        self.running: dict[Future[Ends | None], BlockRun] = {}

    def run(self, cells: Sequence[Cell]) -> Outcome:
        """Runs what is not complete."""
        clock = time.perf_counter()
        clean(self.store.cells)
        clean_void(self.store.claims)
        blocks = blocks_of(cells, self.runtime.workers)
        damaged = self._damaged(cell for block in blocks for cell in block.cells)
        settled = {*damaged, *(cell.id for cell in self.outcome.reused)}
        self.waiting.extend(rest for block in blocks if (rest := block.without(settled)) is not None)
        executor: Executor | None = None
        if self.waiting:
            threads = max(cell.settings["runtime"]["threads"] for cell in cells)
            part = find("executor", self.runtime.executor)
            executor = part.built(self.options, self.runtime.workers, threads, self.store.jobs)
        to_run = [cell for block in self.waiting for cell in block.cells]
        total, episodes = len(to_run) + len(damaged), sum(len(cell.seeds) for cell in to_run)
        self.on_event(SweepStarted(total, len(self.outcome.reused), episodes))
        for end in damaged.values():
            self._note(end)
        if executor is not None:
            self._run_blocks(executor)
        return dataclasses.replace(self.outcome, seconds=time.perf_counter() - clock)

    def _damaged(self, cells: Iterable[Cell]) -> Ends:
        """The damaged cells by id; complete ones are added to the outcome, and what a command that was killed has left
        of their failed attempts is removed."""
        damaged, failed = {}, self.store.failures.is_dir()
        for cell in cells:
            try:
                if self.store.has_cell(cell.id):
                    self.outcome.reused.append(cell)
                    if failed:
                        self.store.clear_failure(cell.id)
            except CheckpointError as error:
                damaged[cell.id] = failure(cell, error)
        return damaged

    def _run_blocks(self, executor: Executor) -> None:
        """Keeps every slot busy until all blocks are settled."""
        finished = False
        try:
            while self.waiting or self.running or self.elsewhere:
                while self.waiting and len(self.running) < executor.slots:
                    block = self.waiting.popleft()
                    name = f"{self.run_id}-{secrets.token_hex(4)}"
                    attempt = BlockRun(block, name, self.run_id, self.prepare, self.store, self.status)
                    self.on_event(BlockStarted(block))
                    self.running[executor.submit(attempt)] = attempt
                for future in wait(self.running, timeout=_POLL_SECONDS, return_when=FIRST_COMPLETED).done:
                    self._settle(self.running.pop(future), future)
                for attempt in self.running.values():
                    self.on_event(BlockRuns(attempt.block, episodes_ended(self.store.claims, attempt.name)))
                self._look_elsewhere()
            finished = True
        finally:
            executor.close(abandon=not finished)
            for attempt in self.running.values():
                release(self.store.claims, attempt.block.cells, attempt.name)

    def _settle(self, attempt: BlockRun, future: Future[Ends | None]) -> None:
        block = attempt.block
        try:
            ends = future.result()
        except WorkerLost as error:
            ends = self._lost(attempt, error)
        except Exception as error:  # noqa: BLE001 - the block could not be sent or its result not be read
            ends = {cell.id: failure(cell, error) for cell in block.cells}
        if ends is None:
            self.elsewhere.append(block)
            self.on_event(BlockWaits(block))
            return
        for cell in block.cells:
            if cell.id in ends:
                self._note(dataclasses.replace(ends[cell.id], cell=cell))  # a worker's copy takes memory of its own

    def _lost(self, attempt: BlockRun, error: WorkerLost) -> Ends:
        """After a worker's end: the cell that ran has failed, complete cells are done, the block's others run again."""
        cells = attempt.block.cells
        last_cell = running_cell(self.store.claims, cells, attempt.name)
        release(self.store.claims, cells, attempt.name)
        ends: Ends = {}
        for cell in cells:
            if last_cell is None or cell is last_cell:  # None: it ended at once, as another attempt would
                ends[cell.id] = failure(cell, error)
            elif self.store.has_cell(cell.id):
                status = self.store.status_of(cell.id)
                sums = status["episodes"], status["successes"], status["seconds"]
                ends[cell.id] = CellEnd(cell, *sums, reused=status["run"] != self.run_id)
        rest = attempt.block.without(ends)
        if rest is not None:
            self.waiting.append(rest)
        return ends

    def _look_elsewhere(self) -> None:
        """When nothing else is left to do, queues the blocks that no other sweep computes any more."""
        if self.waiting or self.running or not self.elsewhere:
            return
        blocks, self.elsewhere = self.elsewhere, []
        for block in blocks:
            claimed = any(is_claimed(self.store.claims, cell) for cell in block.cells)
            (self.elsewhere if claimed else self.waiting).append(block)
        if not self.waiting:
            time.sleep(_POLL_SECONDS)

    def _note(self, end: CellEnd) -> None:
        """Adds a cell's end to the outcome and emits it."""
        if isinstance(end.error, StorageError):
            raise end.error
        if end.reason:
            self.store.write_failure(end.cell.id, f"{end.cell.label} on {end.cell.task}\n\n{end.trace}")
            self.outcome.failed.append(end)
        elif end.reused:
            self.outcome.reused.append(end.cell)
        else:
            self.store.clear_failure(end.cell.id)
            self.outcome.done.append(end.cell)
        self.on_event(end)


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
    status: dict[str, Any] = field(default_factory=dict)

    def __call__(self) -> Ends | None:
        """Ends by cell id; None where another sweep computes one of the cells: nothing was run then."""
        first = self.block.cells[0]
        try:
            if not claim(self.store.claims, self.block.cells, self.run, self.name):
                return None
        except StorageError as error:
            return {first.id: failure(first, error)}
        try:
            ends: Ends = {}
            for cell, step in self._take_turns(ends) if self.block.batch == 1 else self._together(ends):
                try:
                    end = step()
                except Exception as error:  # noqa: BLE001 - one setting's failure must not end the others
                    end = failure(cell, error)
                if end is not None:
                    ends[cell.id] = end
                    if isinstance(end.error, StorageError):
                        break
            return ends
        finally:
            release(self.store.claims, self.block.cells, self.name)

    def _take_turns(self, ends: Ends) -> Iterator[Step]:
        """Builds every setting, then runs them in turn, seed by seed."""
        turns = [_Turn(cell, self) for cell in self.block.cells]
        yield from ((turn.cell, turn.prepare) for turn in turns)
        order = itertools.count()
        for seed in self.block.seeds:
            for turn in (turns[index] for index in self.block.order(seed)):
                if turn.cell.id not in ends:
                    yield turn.cell, functools.partial(turn.take, seed, next(order))

    def _together(self, ends: Ends) -> Iterator[Step]:
        """Takes the episodes of a batch as they end."""
        ends |= {cell.id: CellEnd(cell, reused=True) for cell in self.block.cells if self.store.has_cell(cell.id)}
        turns = {cell.id: _Turn(cell, self) for cell in self.block.cells if cell.id not in ends}
        if not turns:
            return
        note_running(self.store.claims, self.block.cells[0], self.name)
        runner: Any = self.prepare
        try:
            for order, (cell, _, result) in enumerate(runner.together([turn.cell for turn in turns.values()])):
                if cell.id not in ends:  # else another of its episodes failed
                    yield cell, functools.partial(turns[cell.id].add, result, order)
        except Exception as error:  # noqa: BLE001 - what the decodes have in common failed
            ends |= {name: failure(turn.cell, error) for name, turn in turns.items() if name not in ends}


class _Turn:
    """One cell's part in a block. Its methods return the cell's end as soon as it is complete, or raise."""

    def __init__(self, cell: Cell, work: BlockRun) -> None:
        self.cell, self.work = cell, work
        self.device = str(cell.settings["runtime"]["device"])
        self.episodes: list[tuple[EpisodeRecord, Circumstances]] = []
        self.seconds = 0.0

    def prepare(self) -> CellEnd | None:
        """Builds the setting, unless the cell is complete."""
        clock = time.perf_counter()
        if self.work.store.has_cell(self.cell.id):
            return CellEnd(self.cell, reused=True)
        note_running(self.work.store.claims, self.cell, self.work.name)
        self.run_episode = self.work.prepare(self.cell)
        self.seconds += time.perf_counter() - clock
        return None

    def take(self, seed: int, order: int) -> CellEnd | None:
        """Runs one episode; writes the cell after its last one."""
        note_running(self.work.store.claims, self.cell, self.work.name, order)
        started = datetime.now(UTC)
        clock = time.perf_counter()
        record = self.run_episode(seed)
        return self._keep(record, order, started, time.perf_counter() - clock)

    def add(self, result: EpisodeRecord | Exception, order: int) -> CellEnd | None:
        """Takes an episode of a batch, in any order of seeds; writes the cell after its last one."""
        note_running(self.work.store.claims, self.cell, self.work.name, order + 1)
        if isinstance(result, Exception):
            raise result
        started = datetime.now(UTC) - timedelta(seconds=result.wall_seconds)
        return self._keep(result, order, started, result.wall_seconds)

    def _keep(self, record: EpisodeRecord, order: int, started: datetime, seconds: float) -> CellEnd | None:
        at = Circumstances(self.work.name, order, started.isoformat(timespec="milliseconds"))
        self.episodes.append((record, at))
        self.seconds += seconds
        if len(self.episodes) < len(self.cell.seeds):
            return None
        work = self.work
        status = {**stamp(self.device), **work.status, "run": work.run, "pid": os.getpid(), "seconds": self.seconds}
        records, circumstances = zip(*sorted(self.episodes, key=lambda episode: episode[0].seed), strict=True)
        if not work.store.write_cell(self.cell, records, status, circumstances):
            return CellEnd(self.cell, reused=True)
        return CellEnd(self.cell, len(records), sum(record.success for record in records), self.seconds)


def one_line(error: BaseException) -> str:
    """An error in one line: the message of a KervError; type, message and line of the source of any other."""
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    line = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text[:200]}{line}"
