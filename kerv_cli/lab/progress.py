"""Events of a running study, and what becomes of its episodes, whichever process runs them.

Workers and sweeps send the events, and a progress display shows them.
"""

from __future__ import annotations

import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import sqlalchemy as sa

from kerv_cli.base.errors import KervError
from kerv_cli.lab.database import EPISODES, PLANNED, SETTINGS, STUDIES, WANTED
from kerv_cli.lab.plan import Block, Episode, Setting
from kerv_cli.lab.runs import Run
from kerv_cli.lab.store import Study


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
    """A worker builds the decoder of a setting, before it runs the setting's first episode in a block.

    Attributes:
        setting: The setting.
        number: Position of the setting among the block's settings, from 1.
        of: Number of settings in the block.
    """

    setting: Setting
    number: int
    of: int


@dataclass(frozen=True)
class BlocksWait:
    """Other processes run all blocks (groups of episodes) that are left. The worker waits, in case one of them dies."""


@dataclass(frozen=True)
class EpisodeEnd:
    """An episode has ended.

    Attributes:
        episode: The episode.
        success: Whether the task was solved.
        seconds: Wall time.
        elsewhere: Whether another command than this one planned the episode.
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
    """Result of `study.run`. Each episode of the study is in exactly one of the first three lists.

    If workers of a cluster go on without this command (`detached`), the missing episodes are in none.

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


def load_per_core() -> float:
    """Return the load average of this machine per core."""
    return round(os.getloadavg()[0] / (os.cpu_count() or 1), 2)


class Progress:
    """Collects the outcome of a plan: from the events of a worker in this process, and from the database.

    Args:
        study: The study with its plan.
        record: The database row of the command.
        on_event: Called with each event, to show progress.
    """

    def __init__(self, study: Study, record: Run, on_event: OnEvent) -> None:
        self.study, self.record, self.on_event = study, record, on_event
        self.outcome = Outcome(reused=list(study.existing))
        self._missing = {one.key: one for one in study.to_run}
        self._newest, self._began = study.newest, time.perf_counter()
        record.beat(0, len(self._missing))
        is_timed = any(block.batch == 1 for block in study.blocks)
        on_event(Started(len(self._missing), len(study.existing), load_per_core() if is_timed else 0.0))

    def see(self, event: Event) -> None:
        """Take an event of a worker in this process."""
        if isinstance(event, EpisodeEnd):
            one = self._missing.pop(event.episode.key, None)
            if one is None:
                return
            event = replace(event, episode=one)
            (self.outcome.reused if event.elsewhere else self.outcome.done).append(one)
            self.record.beat(len(self.outcome.done))
        elif isinstance(event, SettingFailed):
            known = (self._missing.pop(one.key, one) for one in event.episodes)
            event = replace(event, episodes=tuple(known))
            self.outcome.failed.append(event)
        elif isinstance(event, BlockStarted):
            self.look()
        self.on_event(event)

    def look(self) -> None:
        """Read from the database which episodes other processes have run, and which have failed."""
        for ended in self._ended():
            self.see(ended)
        for failure in self._failed():
            self.see(failure)

    def _ended(self) -> list[EpisodeEnd]:
        ended = []
        for key, rows in self.study.stored(self._newest).items():
            self._newest, row = max(self._newest, rows[-1].id), rows[0]
            if one := self._missing.get(key):
                ended.append(EpisodeEnd(one, row.success, row.seconds or 0.0, row.run != self.record.id))
        return ended

    def _failed(self) -> list[SettingFailed]:
        columns = (SETTINGS.c.work, WANTED.c.task, WANTED.c.seed, WANTED.c.repeat, WANTED.c.error)
        query = sa.select(*columns).select_from(PLANNED).order_by(WANTED.c.position)
        query = query.where(STUDIES.c.name == self.study.name, WANTED.c.error.is_not(None))
        failed: dict[tuple[str, str, str], dict[Episode, None]] = {}
        with self.study.database.reading() as connection:
            for *key, error in connection.execute(query):
                if one := self._missing.get(tuple(key)):
                    failed.setdefault((key[0], key[1], error), {})[one] = None
        found = []
        for (_, _, error), episodes in failed.items():
            reason, _, trace = error.partition("\n")
            found.append(SettingFailed(reason, trace, episodes=tuple(episodes)))
        return found

    def end(self) -> Outcome:
        """Return the outcome, after all blocks have ended.

        Raises:
            KervError: The study was deleted.
        """
        self.look()
        if self._missing:
            if not self.study.exists:
                name = self.study.name
                raise KervError(f"study {name} was deleted while it ran: run the same command to start it again")
            reason = "another command has planned the study anew, without it: run the same command again"
            self.see(SettingFailed(reason, episodes=tuple(self._missing.values())))
        self.outcome.seconds = time.perf_counter() - self._began
        return self.outcome


class TimeLeft:
    """Estimates how long the missing episodes of a plan take, and corrects that with each episode that ends.

    An episode is expected to take the mean time of its setting's episodes, or, if its setting has none, of all
    episodes. The workers share the total equally.

    Args:
        study: The study with its plan.
        guess: Seconds per episode while nothing is measured.
    """

    def __init__(self, study: Study, guess: float) -> None:
        self.workers = max(1, min(study.runtime.workers, len(study.blocks)))
        self._waiting = Counter(one.setting.work for one in study.to_run)
        self._guess, works = guess, {setting.work for setting in study.settings}
        query = sa.select(EPISODES.c.work, sa.func.avg(EPISODES.c.wall_seconds), sa.func.count(EPISODES.c.wall_seconds))
        with study.database.reading() as connection:
            rows = connection.execute(query.where(EPISODES.c.work.in_(works)).group_by(EPISODES.c.work)).all()
        self._stored = {work: float(mean) for work, mean, _ in rows if mean is not None}
        self._ended: Counter[str] = Counter()
        self._measured: defaultdict[str, float] = defaultdict(float)  # seconds of those that ended, by setting
        stored = sum(number for *_, number in rows)
        self.source = f"measured on {stored} stored episodes" if stored else f"a guess of {guess:g} s per episode"

    def see(self, event: Event) -> None:
        """Take an event of the run: an episode that ended, or those that will not run."""
        if isinstance(event, EpisodeEnd):
            self._waiting[event.episode.setting.work] -= 1
            if event.seconds:
                self._ended[event.episode.setting.work] += 1
                self._measured[event.episode.setting.work] += event.seconds
        elif isinstance(event, SettingFailed):
            self._waiting.subtract(one.setting.work for one in event.episodes)

    @property
    def seconds(self) -> float:
        """Estimated seconds until every planned episode has ended or failed."""
        means = self._stored | {work: self._measured[work] / number for work, number in self._ended.items()}
        mean = sum(means.values()) / len(means) if means else self._guess
        return sum(number * means.get(work, mean) for work, number in self._waiting.items()) / self.workers
