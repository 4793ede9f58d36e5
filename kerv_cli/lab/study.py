"""Plan a study and run it: `plan` finds the missing episodes, `run` runs them and follows their progress."""

from __future__ import annotations

import contextlib
import re
import secrets
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime

import sqlalchemy as sa

from kerv_cli.base.durations import count
from kerv_cli.base.errors import Interrupted, KervError, StorageError, UsageError
from kerv_cli.base.paths import check_writable
from kerv_cli.base.runtime import set_up
from kerv_cli.episodes.identity import Setting
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.resolve import ResolvedStudy, located
from kerv_cli.episodes.runner import close_worlds
from kerv_cli.lab.database import EPISODES, PLANNED, SETTINGS, STUDIES, WANTED, Database
from kerv_cli.lab.plan import ALL, Episode, all_episodes
from kerv_cli.lab.runs import Run, interrupted
from kerv_cli.lab.store import ABOUT, ROLLOUT, SWEEP, Study
from kerv_cli.lab.work import (
    BlockStarted,
    EpisodeEnd,
    EpisodeRunner,
    Event,
    OnEvent,
    Prepare,
    Queue,
    Save,
    SettingFailed,
    Started,
    load_per_core,
    patiently,
    work,
)
from kerv_cli.lab.workers import Array, LocalWorkers, gpus_in_turn

SLURM = "slurm"
FOLLOW_SECONDS = 0.3
"""Seconds between two queries of the database while other processes run the blocks."""


def plan(resolved: ResolvedStudy, database: Database, command: Sequence[str], kind: str = SWEEP) -> Study:
    """Check the settings of a sweep or a rollout. Find out which episodes are in the database, and which must run.

    Each call plans a new rollout, unless the same command was interrupted before. Then the rest of its newest rollout
    is planned.

    Args:
        resolved: The study with all its settings.
        database: The database.
        command: Command-line arguments (without `kerv`) that resume the sweep or rollout.
        kind: SWEEP or ROLLOUT.

    Raises:
        UsageError: A setting cannot run, or there are too many episodes.
        CheckpointError: A setting's weights or data cannot be read.
        StorageError: The results folder is not writable.
    """
    runtime, rerun, command = resolved.first.runtime, resolved.sweep.rerun, located(command)
    if kind == SWEEP and runtime.detach and runtime.executor != SLURM:
        raise UsageError("runtime.detach=true is for clusters: add runtime.executor=slurm")
    check_writable(str(database.results))
    about, settings = resolved.study, []
    for label, one in resolved.settings.items():
        point, identity = resolved.points[label], check(one)
        if one.runtime.executor != SLURM:
            one.runtime.device, _ = set_up(one.runtime)
        elif one.runtime.device == "auto":  # the nodes choose their device: this machine may have no GPU
            one.runtime.device = "cuda" if one.runtime.executor_options.gpus else "cpu"
        plain = asdict(one)
        del plain["task"]
        settings.append(Setting(label, point.words, plain, identity, point.varies, point.name))
    settings.sort(key=lambda setting: setting.label != about.baseline)
    episodes = all_episodes(settings, resolved.tasks, about.block)
    own = {name: getattr(about, name) for name in ABOUT}
    study = Study(database, about.name, kind, tuple(settings), episodes, **own)
    if kind == SWEEP:
        study.check_source(command)
        begun = interrupted(database, kind, command, study.name) if rerun == ALL else None
    else:
        begun = interrupted(database, kind, command)
        done, total = replace(study, name=begun.name).counts() if begun else (0, 0)
        begun = begun if 0 < done < total else None
        study = replace(study, name=begun.name if begun else new_name(study))
        rerun, runtime = ALL, replace(runtime, workers=1, executor="local")
    return study.plan(rerun, begun.started if begun else "", runtime, command)


def new_name(study: Study) -> str:
    """Return a name for a new rollout, with date, time and methods: `20260301-142530-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(setting.settings["method"]) for setting in study.settings))
    name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:32]}"
    return f"{name}-{secrets.token_hex(2)}" if replace(study, name=name).exists else name


@dataclass
class Outcome:
    """Result of `study.run`. Each episode of the study is in exactly one of the first three lists.

    But if workers of a cluster go on without this command (`detached`), the missing episodes are in none of the lists.

    Attributes:
        done: Episodes that this command planned and that were run.
        reused: Episodes that were in the database already, or that another command planned and ran.
        failed: Settings that failed, with their episodes.
        seconds: Wall time.
        detached: Says which workers of a cluster run the missing episodes. Empty if no cluster runs them.
    """

    done: list[Episode] = field(default_factory=list)
    reused: list[Episode] = field(default_factory=list)
    failed: list[SettingFailed] = field(default_factory=list)
    seconds: float = 0.0
    detached: str = ""


def run(study: Study, on_event: OnEvent = lambda event: None, *, save: Save = lambda *_: None) -> Outcome:
    """Run the missing episodes of a plan. Each episode is saved in the database as soon as it ends.

    Args:
        study: The study with its plan.
        on_event: Called with each event, to show progress.
        save: Writes the recording (.rrd file) of an episode. The default writes nothing.

    Raises:
        Interrupted: Ctrl-C was pressed.
        KervError: An episode of a rollout failed.
        StorageError: The disk is full or not writable.
    """
    is_rollout = study.kind == ROLLOUT

    def forward(event: Event) -> None:
        if isinstance(event, SettingFailed) and is_rollout:
            raise event.error or KervError(event.reason)
        on_event(event)

    prepare = EpisodeRunner(study.rollouts, save)
    try:
        with Run(study.database, study.kind, study.name, study.command, len(study.to_run), is_rollout) as record:
            try:
                return run_blocks(study, prepare, record, forward)
            except KeyboardInterrupt:
                raise Interrupted(
                    f"interrupted: {_kept(study)} of {study.name} are kept: run the same command to resume"
                ) from None
            finally:
                close_worlds()
    except Detached as detached:
        return Outcome(reused=list(study.existing), detached=str(detached))


class Detached(Interrupted):
    """The workers of a cluster go on without this command. The error's message names the workers."""


def run_blocks(study: Study, prepare: Prepare, record: Run, on_event: OnEvent) -> Outcome:
    """Queue the blocks (groups of episodes) of a plan. Run them in this process, in worker processes or on a cluster.

    When this function returns or raises, no process of this machine runs the plan's blocks any more. No block stays
    queued, unless the workers of a cluster go on without this command. They also go on if this process is killed.

    Args:
        study: The study with its plan.
        prepare: Builds a setting's decoder for a task. Used in this process only.
        record: The database row of this command.
        on_event: Called with each event, to show progress.

    Raises:
        Detached: `runtime.detach` is set, and workers of a cluster run the blocks. The message names them.
    """
    runtime, blocks = study.runtime, study.blocks
    queue = Queue(study, record.id)
    queue.fill()
    progress = Progress(study, record, on_event)
    threads = max((one.setting.settings["runtime"]["threads"] for one in study.to_run), default=1)
    try:
        if blocks and runtime.executor == SLURM:
            array = Array(queue, runtime, threads)
            if runtime.detach:
                raise Detached(f"job {array.id} of Slurm runs them, its logs are in {array.logs}")
            with array:
                progress.follow(queue, lambda: array.tend(progress.ended))
        elif blocks and runtime.workers > 1:
            number = min(runtime.workers, len(blocks))
            with LocalWorkers(queue, number, threads, gpus_in_turn(study.device)) as workers:
                progress.follow(queue, workers.tend)
        elif blocks:
            work(queue, prepare, progress.see)
        return progress.end()
    except Detached:
        raise
    except BaseException:
        with contextlib.suppress(StorageError):
            queue.withdraw()
        raise


def _kept(study: Study) -> str:
    """Return how many episodes of a study are stored, as text. The text has no numbers if the database fails."""
    try:
        done, total = study.counts()
        return f"{done} of {count(total or len(study.episodes), 'episode')}"  # its plan may not be written yet
    except StorageError:
        return "all complete episodes"


class Progress:
    """Collects the outcome of a plan, from the events of a worker in this process and from the database.

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
        is_timed = any(block.batch == 1 for block in study.blocks)
        on_event(Started(len(self._missing), len(study.existing), load_per_core() if is_timed else 0.0))

    def see(self, event: Event) -> None:
        """Update the outcome with an event, and pass the event on to `on_event`."""
        if isinstance(event, EpisodeEnd):
            one = self._missing.pop(event.episode.key, None)
            if one is None:
                return
            event = replace(event, episode=one)
            (self.outcome.reused if event.elsewhere else self.outcome.done).append(one)
            self.record.beat(len(self.outcome.done))
        elif isinstance(event, SettingFailed):
            event = replace(event, episodes=tuple(self._missing.pop(one.key, one) for one in event.episodes))
            self.outcome.failed.append(event)
        elif isinstance(event, BlockStarted):
            self.look()
        self.on_event(event)

    @property
    def ended(self) -> int:
        """Number of episodes and settings that have ended or failed so far."""
        return len(self.outcome.done) + len(self.outcome.failed)

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
        columns = (SETTINGS.c.work, WANTED.c.task, WANTED.c.seed, WANTED.c.error)
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

    def follow(self, queue: Queue, tend: Callable[[], None]) -> None:
        """Wait until every block (group of episodes) of a queue has ended. Show the progress of the workers.

        Args:
            queue: The blocks.
            tend: Replaces workers that have ended. It is called each time before the database is read.
        """
        shown: set[tuple[int, str]] = set()
        while patiently(queue.left)[0]:
            tend()
            for position, worker in patiently(queue.claimed):
                if (position, worker) not in shown:
                    shown.add((position, worker))
                    self.on_event(BlockStarted(self.study.blocks[position]))
            patiently(self.look)
            time.sleep(FOLLOW_SECONDS)

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
    """Estimates how long the missing episodes of a plan take, and corrects the estimate when an episode ends.

    An episode is expected to take the mean time of its setting's finished episodes. A setting without finished episodes
    gets the average of the other settings' means. The workers share the total equally.

    Args:
        study: The study with its plan.
        guess: Seconds per episode while no episode is measured.
    """

    def __init__(self, study: Study, guess: float) -> None:
        self.workers = max(1, min(study.runtime.workers, len(study.blocks)))
        self._waiting = Counter(one.setting.work for one in study.to_run)
        self._guess, works = guess, {setting.work for setting in study.settings}
        query = sa.select(EPISODES.c.work, sa.func.avg(EPISODES.c.wall_seconds), sa.func.count(EPISODES.c.wall_seconds))
        with study.database.reading() as connection:
            rows = connection.execute(query.where(EPISODES.c.work.in_(works)).group_by(EPISODES.c.work)).all()
        self._stored: dict[str, float] = {}
        stored = 0
        for key, mean, number in rows:
            stored += number
            if mean is not None:
                self._stored[key] = float(mean)
        self._ended: Counter[str] = Counter()
        self._measured: defaultdict[str, float] = defaultdict(float)  # seconds of those that ended, by setting
        self.source = (
            f"measured on {count(stored, 'stored episode')}" if stored else f"a guess of {guess:g} s per episode"
        )

    def see(self, event: Event) -> None:
        """Update the estimate with an event of the run: an episode that ended, or episodes that will not run."""
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
        means = dict(self._stored)
        for key, number in self._ended.items():
            means[key] = self._measured[key] / number
        mean = sum(means.values()) / len(means) if means else self._guess
        seconds = 0.0
        for key, number in self._waiting.items():
            seconds += number * means.get(key, mean)
        return seconds / self.workers
