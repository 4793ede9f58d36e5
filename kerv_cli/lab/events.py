"""Events of a running sweep: `execute` emits them, the progress display shows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from kerv_cli.base.errors import KervError
from kerv_cli.lab.plan import Block, Cell


@dataclass(frozen=True)
class CellEnd:
    """The end of a cell, complete or failed; the rest of its block goes on. It is pickled: of an exception that is not
    kerv's only the text is kept. seconds: wall time of its episodes and of preparing its setting."""

    cell: Cell
    episodes: int = 0
    successes: int = 0
    seconds: float = 0.0
    reused: bool = False  # another sweep completed it while this one ran
    reason: str = ""  # of a failure, in one line; empty: complete
    trace: str = ""
    error: KervError | None = None


@dataclass(frozen=True)
class Outcome:
    """The result of a sweep. Every cell of the plan is in exactly one of the three lists."""

    done: list[Cell] = field(default_factory=list)  # run now
    reused: list[Cell] = field(default_factory=list)  # complete before
    failed: list[CellEnd] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class SweepStarted:
    """The sweep begins. total: cells to run. episodes: of those cells."""

    total: int
    reused: int
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
class BlockRuns:
    """A block runs in another process. ended: its episodes that have ended; its cells are told when all have."""

    block: Block
    ended: int


Event = SweepStarted | BlockStarted | BlockWaits | BlockRuns | CellEnd
OnEvent = Callable[[Event], None]
