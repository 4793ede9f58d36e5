"""Events of a running study: `execute` emits them, a display shows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from kerv_cli.base.errors import KervError
from kerv_cli.lab.plan import Block, Wanted


@dataclass(frozen=True)
class EpisodeEnd:
    """The end of an episode.

    Attributes:
        wanted: What it means.
        success: Whether the task was solved.
        seconds: Wall time.
        elsewhere: Another sweep ran it while this one ran.
    """

    wanted: Wanted
    success: bool = False
    seconds: float = 0.0
    elsewhere: bool = False


@dataclass(frozen=True)
class SettingFailed:
    """A setting failed on a block of seeds; the block's other settings go on.

    Attributes:
        wanted: The episodes that it leaves out, the one that failed first.
        reason: The error in one line.
        trace: Its traceback.
        error: The error, if it is one of kerv's own.
    """

    wanted: tuple[Wanted, ...]
    reason: str
    trace: str = ""
    error: KervError | None = None


@dataclass(frozen=True)
class Outcome:
    """The result of `execute`. Every wanted episode is in exactly one of the three."""

    done: list[Wanted] = field(default_factory=list)  # run now
    reused: list[Wanted] = field(default_factory=list)  # there before, or run by another sweep
    failed: list[SettingFailed] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class Started:
    """The run begins. to_run, reused: numbers of episodes."""

    to_run: int
    reused: int


@dataclass(frozen=True)
class BlockStarted:
    """A block was handed to the executor."""

    block: Block


@dataclass(frozen=True)
class BlockEnded:
    """A block is over."""

    block: Block


@dataclass(frozen=True)
class BlockWaits:
    """Another sweep computes the block; `execute` looks at it again later."""

    block: Block


Event = Started | BlockStarted | BlockEnded | BlockWaits | EpisodeEnd | SettingFailed
OnEvent = Callable[[Event], None]
