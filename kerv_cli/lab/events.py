"""Events of a running sweep: `execute` emits them, the progress display shows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from kerv_cli.lab.plan import Block, Cell


@dataclass(frozen=True)
class CellFailed:
    """A cell failed, with the reason in one line; the rest of its block goes on."""

    cell: Cell
    reason: str


@dataclass(frozen=True)
class Outcome:
    """The result of a sweep. Every cell of the plan is in exactly one of the three lists."""

    done: list[Cell] = field(default_factory=list)  # run now
    reused: list[Cell] = field(default_factory=list)  # complete before
    failed: list[CellFailed] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class SweepStarted:
    """The sweep begins. total: cells to run. workers: blocks that run at the same time. episodes: of those cells."""

    total: int
    reused: int
    workers: int
    episodes: int


@dataclass(frozen=True)
class BlockStarted:
    """A block was handed to the executor."""

    block: Block


@dataclass(frozen=True)
class BlockWaits:
    """Another sweep computes cells of the block; `execute` looks at it again later."""

    block: Block


@dataclass(frozen=True)
class CellDone:
    """A cell completed and is stored. seconds: wall time of its episodes and of preparing its setting."""

    cell: Cell
    episodes: int
    successes: int
    seconds: float


@dataclass(frozen=True)
class CellReused:
    """Another sweep completed the cell while this one ran."""

    cell: Cell


@dataclass(frozen=True)
class SweepFinished:
    """Every cell is done, reused or failed: the last event."""

    outcome: Outcome


Event = SweepStarted | BlockStarted | BlockWaits | CellDone | CellFailed | CellReused | SweepFinished
OnEvent = Callable[[Event], None]
