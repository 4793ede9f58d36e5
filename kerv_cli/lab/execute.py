"""Runs a study's blocks through an executor: resumes, isolates failures, shares work with other sweeps, emits events.

The process that runs a block also writes its cells, so a crash loses at most the running cells.
"""

from __future__ import annotations

import dataclasses
import secrets
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from datetime import UTC, datetime
from typing import Any

from kerv_cli.base.errors import CheckpointError, StorageError
from kerv_cli.base.leftovers import clean
from kerv_cli.base.provenance import git_commit
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.lab import events
from kerv_cli.lab.block import BlockRun, CellResult, Gauge, Prepare, failed
from kerv_cli.lab.claims import clean_void, is_claimed, release, running_cell
from kerv_cli.lab.code import code_hash
from kerv_cli.lab.executors import Executor, WorkerLost, check_executor, open_executor
from kerv_cli.lab.identity import ENGINE
from kerv_cli.lab.plan import Block, Cell, blocks_of
from kerv_cli.lab.store import StudyStore

_POLL_SECONDS = 1.0  # between two looks at blocks that another sweep computes


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
    total = sum(len(block.cells) for block in blocks) + len(damaged)
    on_event(events.SweepStarted(total, len(sweep.outcome.reused), runtime.workers))
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
        self.running: dict[Future[Any], BlockRun] = {}

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
                    self._start(self.waiting.popleft(), executor)
                for future in wait(self.running, timeout=_POLL_SECONDS, return_when=FIRST_COMPLETED).done:
                    self._settle(self.running.pop(future), future)
                self._look_elsewhere()
            finished = True
        finally:
            executor.close(abandon=not finished)
            for attempt in self.running.values():
                release(self.store.claims, attempt.block.cells, attempt.name)

    def _start(self, block: Block, executor: Executor) -> None:
        name = f"{self.run_id}-{secrets.token_hex(4)}"
        attempt = BlockRun(block, name, self.run_id, self.prepare, self.store, self.gauge, self.status)
        self.on_event(events.BlockStarted(block))
        self.running[executor.submit(attempt)] = attempt

    def _settle(self, attempt: BlockRun, future: Future[dict[str, CellResult] | None]) -> None:
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

    def _note_all(self, block: Block, results: Mapping[str, CellResult]) -> None:
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
                stored = self.store.read_cell(cell.id)
                sums = stored.status["episodes"], stored.status["successes"], stored.status["seconds"]
                results[cell.id] = CellResult(*sums, reused=stored.status["run"] != self.run_id)
        self._note_all(attempt.block, results)
        rest = attempt.block.without(results)
        if rest is not None:
            self.waiting.append(rest)

    def _look_elsewhere(self) -> None:
        """When nothing else is left to do, queues the blocks that no other sweep computes any more."""
        if self.waiting or self.running or not self.elsewhere:
            return
        claimed = [any(is_claimed(self.store.claims, cell) for cell in block.cells) for block in self.elsewhere]
        if all(claimed):
            time.sleep(_POLL_SECONDS)
            return
        self.waiting.extend(block for block, theirs in zip(self.elsewhere, claimed, strict=True) if not theirs)
        self.elsewhere = [block for block, theirs in zip(self.elsewhere, claimed, strict=True) if theirs]

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
