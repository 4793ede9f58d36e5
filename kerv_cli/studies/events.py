"""What happens while cells run, as values: a sweep emits them, a progress display reads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from kerv_cli.studies.plan import Block, Cell


@dataclass(frozen=True)
class Failure:
    """A cell that did not complete, and why in one line."""

    cell: Cell
    reason: str


@dataclass(frozen=True)
class Outcome:
    """The end of a sweep. Every asked-for cell is in exactly one of the three lists."""

    done: list[Cell] = field(default_factory=list)  # run now
    reused: list[Cell] = field(default_factory=list)  # complete before
    failed: list[Failure] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class SweepStarted:
    """total: cells to run. workers: blocks that run at the same time."""

    total: int
    reused: int
    workers: int


@dataclass(frozen=True)
class BlockStarted:
    """A block was handed to the executor."""

    block: Block


@dataclass(frozen=True)
class BlockWaits:
    """Another sweep computes cells of the block; it is looked at again later."""

    block: Block


@dataclass(frozen=True)
class CellDone:
    """seconds: wall time of its episodes, with what it took to prepare them."""

    cell: Cell
    episodes: int
    successes: int
    seconds: float


@dataclass(frozen=True)
class CellFailed:
    """A cell did not complete; the rest of its block goes on."""

    cell: Cell
    reason: str


@dataclass(frozen=True)
class CellReused:
    """Another sweep completed the cell while this one ran."""

    cell: Cell


@dataclass(frozen=True)
class SweepFinished:
    """The last event."""

    outcome: Outcome


Event = SweepStarted | BlockStarted | BlockWaits | CellDone | CellFailed | CellReused | SweepFinished
OnEvent = Callable[[Event], None]
