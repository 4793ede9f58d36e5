"""Shows a sweep's events: a progress bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from kerv_cli.base.durations import left
from kerv_cli.lab.events import BlockRuns, BlockStarted, BlockWaits, CellEnd, Event, SweepStarted
from kerv_cli.lab.plan import Block, Cell

LOG_SECONDS = 30.0
"""Between two lines of progress where the output is no terminal."""


class ProgressDisplay:
    """The `on_event` callback of `execute`; a context manager that ends the bar. The bar counts episodes, because the
    cells of a block end together: a block in another process tells the episodes that have ended; where episodes run in
    this process, `on_step` moves the bar within a cell and within an episode too."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self._bar: Progress | None = None
        self._task = TaskID(0)
        self._total = self._finished = 0  # cells
        self._episodes = self._ended = 0  # episodes, of all cells and of the finished ones
        self._began = self._logged = 0.0
        self._running: dict[str, Block] = {}  # by title, without their ended cells
        self._parts: dict[str, float] = {}  # episodes, whole and in part, of unfinished cells (by id) or blocks

    def __enter__(self) -> ProgressDisplay:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, event: Event) -> None:
        if isinstance(event, SweepStarted):
            self._start(event)
        elif isinstance(event, BlockStarted):
            self._running[event.block.title] = event.block
        elif isinstance(event, BlockRuns):
            self._parts[event.block.title] = event.ended
        elif isinstance(event, BlockWaits):
            self._running.pop(event.block.title, None)
            self._parts.pop(event.block.title, None)
            self.console.print(f"{event.block.name}: another sweep computes it", soft_wrap=True, highlight=False)
        else:
            self._finish(event.cell, _result(event))
        if self._bar is not None or isinstance(event, BlockRuns):
            self._show(self._now)

    def on_step(self, cell: Cell, seed: int, step: int) -> None:
        """Shows that `step` control steps of a seed's episode were executed; at most one episode runs at a time."""
        horizon, seeds = int(cell.settings["world"]["horizon"]), list(cell.seeds)
        # half an episode's share for a step at half the horizon: successful episodes end early and then jump
        self._parts[cell.id] = seeds.index(seed) + min(1.0, step / max(1, horizon))
        self._show(f"{escape(cell.label)} on {cell.task}, seed {seed}: step {step}")

    def _show(self, now: str) -> None:
        """Moves the bar; where there is none, prints a line if the last one is old."""
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, count=self._count, description=now)
        elif time.monotonic() - self._logged > LOG_SECONDS:
            self._logged = time.monotonic()
            rest = f"{left(self._logged - self._began, max(self._done, 0.1), self._episodes)}; " if self._done else ""
            self.console.print(f"{self._count}, {rest}{now}", soft_wrap=True, highlight=False)

    @property
    def _done(self) -> float:
        return self._ended + sum(self._parts.values())

    @property
    def _count(self) -> str:
        return f"{int(self._done)}/{self._episodes} episodes"

    def _start(self, event: SweepStarted) -> None:
        self._total, self._finished = event.total, 0
        self._episodes, self._ended = event.episodes, 0
        self._began = self._logged = time.monotonic()
        self._parts.clear()
        if self._bar is not None:
            self._bar.stop()
        if event.reused:
            self.console.print(f"{event.reused} cells are complete already")
        if not self.console.is_terminal or not event.total:
            return
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, console=self.console, transient=True)
        self._task = self._bar.add_task("preparing", total=event.episodes, count=self._count)
        self._bar.start()

    def _finish(self, cell: Cell, result: str) -> None:
        for title, block in list(self._running.items()):
            rest = block.without({cell.id})
            if rest != block:
                del self._running[title]
                self._parts.pop(title, None)
            if rest is not None:
                self._running[rest.title] = rest
        self._finished += 1
        self._ended += len(cell.seeds)
        self._parts.pop(cell.id, None)
        count = f"[dim]{self._finished:{len(str(self._total))}}/{self._total}[/dim]"
        alone = f", seed {cell.seeds[0]}" if len(cell.seeds) == 1 else ""
        line = f"{count} {escape(cell.label)} on {cell.task}{alone}: {result}"
        self.console.print(line, soft_wrap=True, highlight=False)

    @property
    def _now(self) -> str:
        names = [block.title for block in self._running.values()]
        more = f" +{len(names) - 1}" if len(names) > 1 else ""
        return escape(names[0] + more if names else "cells")


def _result(end: CellEnd) -> str:
    if end.reason:
        return f"[red]failed[/red]: {escape(end.reason)}"
    if end.reused:
        return "completed by another sweep"
    if end.episodes == 1:
        return f"{'success' if end.successes else 'failure'}, {end.seconds:.1f} s"
    rate = end.seconds / max(1, end.episodes)
    return f"{end.successes}/{end.episodes} succeeded, {rate:.1f} s per episode"
