"""Events of a running study. Workers and sweeps send them, and a progress display shows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from kerv_cli.base.errors import KervError
from kerv_cli.lab.plan import Block, Episode, Setting


@dataclass(frozen=True)
class Started:
    """The run begins.

    Attributes:
        to_run: Number of episodes to run.
        reused: Number of episodes that are in the database already.
        load: Load average per core at the start. 0 if no episode is timed.
    """

    to_run: int
    reused: int
    load: float = 0.0


@dataclass(frozen=True)
class BlockStarted:
    """A worker has claimed a block (episodes that one process runs)."""

    block: Block


@dataclass(frozen=True)
class Preparing:
    """A worker builds the decoder of a setting, before the first episode of its block.

    Attributes:
        setting: The setting.
        number: Its place among the block's settings, from 1.
        of: Number of settings in the block.
    """

    setting: Setting
    number: int
    of: int


@dataclass(frozen=True)
class BlocksWait:
    """Other processes run all blocks that are left. The worker waits, to take over those of a process that dies."""


@dataclass(frozen=True)
class EpisodeEnd:
    """An episode has ended.

    Attributes:
        episode: The episode.
        success: Whether the task was solved.
        seconds: Wall time.
        elsewhere: Whether another command has planned it.
    """

    episode: Episode
    success: bool = False
    seconds: float = 0.0
    elsewhere: bool = False


@dataclass(frozen=True)
class SettingFailed:
    """A setting failed in a block (episodes that one process runs). The block's other settings go on.

    Attributes:
        reason: The error in one line.
        trace: The error's traceback.
        error: The error itself if it is a KervError that was raised in this process, else None.
        episodes: The episode that failed, and then the episodes that will not run because of it.
    """

    reason: str
    trace: str = ""
    error: KervError | None = None
    episodes: tuple[Episode, ...] = ()


@dataclass
class Outcome:
    """Result of `study.run`. Each episode of the study is in exactly one of the three lists, unless it was detached.

    Attributes:
        done: Episodes that this command planned and that were run.
        reused: Episodes that were in the database already, or that another command planned and ran.
        failed: Settings that failed, with their episodes.
        seconds: Wall time.
        detached: Says which workers of a cluster run the missing episodes. Empty: none do.
    """

    done: list[Episode] = field(default_factory=list)
    reused: list[Episode] = field(default_factory=list)
    failed: list[SettingFailed] = field(default_factory=list)
    seconds: float = 0.0
    detached: str = ""


Event = Started | BlockStarted | Preparing | BlocksWait | EpisodeEnd | SettingFailed
OnEvent = Callable[[Event], None]
