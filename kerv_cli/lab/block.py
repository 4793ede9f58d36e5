"""Runs a block in one process: its settings take turns, episode by episode, and a cell is written after its last
episode."""

from __future__ import annotations

import math
import os
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Protocol, runtime_checkable

from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.base.provenance import stamp
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab.claims import claim, note_running, release
from kerv_cli.lab.plan import Block, Cell
from kerv_cli.lab.rows import Circumstances
from kerv_cli.lab.store import StudyStore

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


def failed(error: BaseException) -> CellResult:
    """The result of a cell that raised `error`, inside an except clause."""
    return CellResult(reason=one_line(error), trace=traceback.format_exc(), storage=isinstance(error, StorageError))


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

    def __call__(self) -> dict[str, CellResult] | None:
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

    def _take_turns(self) -> dict[str, CellResult]:
        results: dict[str, CellResult] = {}
        turns: dict[int, _Turn] = {}
        for index, cell in enumerate(self.block.cells):
            turn = _Turn(cell, self)
            result = turn.prepare()
            if result is None:
                turns[index] = turn
            else:
                results[cell.id] = result
        order = 0
        for seed in self.block.seeds:
            for index in self.block.order(seed):
                if index not in turns:
                    continue
                result = turns[index].take(seed, order)
                order += 1
                if result is not None:
                    results[turns.pop(index).cell.id] = result
                    if result.storage:
                        return results
        return results

    def _together(self) -> dict[str, CellResult]:
        """Runs the cells of a batch; a cell is written as soon as its last episode has ended."""
        results: dict[str, CellResult] = {}
        cells = [cell for cell in self.block.cells if not self.store.has_cell(cell.id)]
        results |= {cell.id: CellResult(reused=True) for cell in self.block.cells if cell not in cells}
        turns = {cell.id: _Turn(cell, self) for cell in cells}
        try:
            if not isinstance(self.prepare, Together):
                raise TypeError(f"{type(self.prepare).__name__} runs one episode at a time, not {self.block.batch}")
            note_running(self.store.claims, self.block.cells[0], self.name)
            for order, (cell, seed, end) in enumerate(self.prepare.together(cells) if cells else ()):
                if cell.id in results:
                    continue  # another of its episodes failed
                note_running(self.store.claims, cell, self.name)
                result = turns[cell.id].add(seed, end, order)
                if result is not None:
                    results[cell.id] = result
                    if result.storage:
                        return results
        except Exception as error:  # noqa: BLE001 - what the decodes have in common failed
            results = dict.fromkeys(turns, failed(error)) | results
        return results


class _Turn:
    """One cell's part in a block. Its methods return the cell's result as soon as it has failed or is complete."""

    def __init__(self, cell: Cell, work: BlockRun) -> None:
        self.cell, self.work = cell, work
        self.records: list[EpisodeRecord] = []
        self.circumstances: list[Circumstances] = []
        self.seconds = 0.0

    def prepare(self) -> CellResult | None:
        """Builds the setting, unless the cell is complete."""
        clock = time.perf_counter()
        try:
            if self.work.store.has_cell(self.cell.id):
                return CellResult(reused=True)
            note_running(self.work.store.claims, self.cell, self.work.name)
            self.run_episode = self.work.prepare(self.cell)
        except Exception as error:  # noqa: BLE001 - one setting's failure of any kind must not end the others
            return failed(error)
        self.seconds += time.perf_counter() - clock
        return None

    def take(self, seed: int, order: int) -> CellResult | None:
        """Runs one episode; writes the cell after its last one."""
        try:
            note_running(self.work.store.claims, self.cell, self.work.name)
            started = datetime.now(UTC).isoformat(timespec="milliseconds")
            load = self.work.gauge(self._device) if self.work.gauge is not None else math.nan
            at = Circumstances(self.work.name, order, started, load)
            clock = time.perf_counter()
            self.records.append(self.run_episode(seed))
            self.circumstances.append(at)
            self.seconds += time.perf_counter() - clock
            return self._write() if len(self.records) == len(self.cell.seeds) else None
        except Exception as error:  # noqa: BLE001 - as above
            return failed(error)

    def add(self, seed: int, end: EpisodeRecord | Exception, order: int) -> CellResult | None:
        """Takes an episode of a batch, in any order of seeds; writes the cell after its last one."""
        try:
            if isinstance(end, Exception):
                raise end
            now = datetime.now(UTC).timestamp()
            started = datetime.fromtimestamp(now - end.wall_seconds, UTC).isoformat(timespec="milliseconds")
            self.records.append(end)
            self.circumstances.append(Circumstances(self.work.name, order, started))
            self.seconds += end.wall_seconds
            if len(self.records) < len(self.cell.seeds):
                return None
            pairs = sorted(zip(self.records, self.circumstances, strict=True), key=lambda pair: pair[0].seed)
            self.records, self.circumstances = [record for record, _ in pairs], [at for _, at in pairs]
            return self._write()
        except Exception as error:  # noqa: BLE001 - one setting's failure of any kind must not end the others
            return failed(error)

    @property
    def _device(self) -> str:
        return str(self.cell.settings["runtime"]["device"])

    def _write(self) -> CellResult:
        status = {**stamp(self._device), **self.work.status, "run": self.work.run, "pid": os.getpid()}
        status |= {"seconds": self.seconds}
        if not self.work.store.write_cell(self.cell, self.records, status, self.circumstances):
            return CellResult(reused=True)
        return CellResult(len(self.records), sum(record.success for record in self.records), self.seconds)


def one_line(error: BaseException) -> str:
    """An error in one line: the message of a KervError; type, message and line of the source of any other."""
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    line = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text[:200]}{line}"
