"""Events of a running study: `execute` emits them, a display shows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from kerv_cli.base.errors import KervError
from kerv_cli.lab.plan import Block, Episode


@dataclass(frozen=True)
class Started:
    """The run begins.

    Attributes:
        to_run: Number of episodes to run.
        reused: Number of episodes that exist.
    """

    to_run: int
    reused: int


@dataclass(frozen=True)
class BlockStarted:
    """A block was given to the executor."""

    block: Block


@dataclass(frozen=True)
class BlockEnded:
    """A block is over."""

    block: Block


@dataclass(frozen=True)
class BlockWaits:
    """Another sweep runs the block. `execute` looks at it again later."""

    block: Block


@dataclass(frozen=True)
class EpisodeEnd:
    """The end of an episode.

    Attributes:
        episode: The episode.
        success: Whether the task was solved.
        seconds: Wall time.
        elsewhere: Whether another sweep ran it in the meantime.
    """

    episode: Episode
    success: bool = False
    seconds: float = 0.0
    elsewhere: bool = False


@dataclass(frozen=True)
class SettingFailed:
    """A setting failed in a block; the other settings of the block go on.

    Attributes:
        reason: The error in one line.
        trace: Its traceback.
        error: The error, if kerv raised it deliberately. Other errors may not be picklable.
        episodes: The episodes that do not run. The one that failed is the first.
    """

    reason: str
    trace: str = ""
    error: KervError | None = None
    episodes: tuple[Episode, ...] = ()


@dataclass
class Outcome:
    """The result of `execute`. Each episode of the study is in exactly one of the three lists.

    Attributes:
        done: Episodes that ran.
        reused: Episodes that existed, or that another sweep ran.
        failed: Settings that failed, with their episodes.
        seconds: Wall time.
    """

    done: list[Episode] = field(default_factory=list)
    reused: list[Episode] = field(default_factory=list)
    failed: list[SettingFailed] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, other: Outcome) -> None:
        """Add the result of another part of the study."""
        self.done += other.done
        self.reused += other.reused
        self.failed += other.failed
        self.seconds += other.seconds


Event = Started | BlockStarted | BlockEnded | BlockWaits | EpisodeEnd | SettingFailed
OnEvent = Callable[[Event], None]
