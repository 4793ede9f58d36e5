"""What happens while cells run, as values: the executor emits them, a progress display reads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from kerv_cli.studies.plan import Cell


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
    total: int  # cells to run
    reused: int
    workers: int


@dataclass(frozen=True)
class CellStarted:
    cell: Cell


@dataclass(frozen=True)
class CellDone:
    cell: Cell
    episodes: int
    successes: int
    seconds: float  # wall time of the cell


@dataclass(frozen=True)
class CellFailed:
    cell: Cell
    reason: str


@dataclass(frozen=True)
class CellReused:
    """Another sweep completed the cell while this one ran."""

    cell: Cell


@dataclass(frozen=True)
class SweepFinished:
    outcome: Outcome


Event = SweepStarted | CellStarted | CellDone | CellFailed | CellReused | SweepFinished
OnEvent = Callable[[Event], None]
