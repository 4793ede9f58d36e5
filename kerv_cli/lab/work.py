"""A worker: claims a block of episodes, runs it, commits each episode when it ends, and claims the next.

Within a block the settings take turns in one process, episode by episode. A worker that is killed loses at most the
episodes that are running. Another worker runs the rest of its block. If two workers die in the same episode, its
setting fails in this block.

The blocks that wait or run are in the queue, a table of the database. A claim lasts as long as the worker writes its
heartbeat. Times are those of the database's own clock, because the clocks of two machines may differ. Every change is
one transaction, and a database has one writer at a time.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import secrets
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, EpisodeError, KervError, StorageError
from kerv_cli.base.runtime import set_up
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.identity import ENGINE, OBSERVATION, Setting
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.rows import decodes_table, episode_row, seconds_blob, table_blob
from kerv_cli.episodes.runner import Request, Runner, close_worlds, is_recorded, run_batch
from kerv_cli.lab.database import QUEUE, SETTINGS, STUDIES, Unanswered, clock, now
from kerv_cli.lab.plan import Block, Episode, StoredEpisode, seeds_text, split
from kerv_cli.lab.runs import is_running
from kerv_cli.lab.store import ROLLOUT, Study, setting_of
from kerv_cli.targets.provenance import stamp

T = TypeVar("T")

BEAT_SECONDS = 5.0
"""Seconds between two heartbeats of a claim."""
LAPSE_SECONDS = 30.0
"""Seconds without a heartbeat after which other workers may claim the block."""
PATIENCE_SECONDS = 120.0
"""Seconds for which a worker tries to reach a database that does not answer."""
POLL_SECONDS = 1.0
"""Seconds between two queries of the queue while other processes run all blocks that are left."""

RunEpisode = Callable[[int], EpisodeRecord]
"""Function that runs the episode with a given seed."""

Prepare = Callable[[Setting, str], RunEpisode]
"""Object that, when called, builds and warms up a setting's decoder for a task. Its method `together` runs batches."""

Save = Callable[[EpisodeRecord, Path, str], object]
"""Function that writes an episode to a .rrd file. The last argument is the setting's label."""


@dataclass(frozen=True)
class Started:
    """A run of a study's missing episodes begins.

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
    """Other processes run all remaining blocks (groups of episodes). The worker waits, in case a process dies."""


@dataclass(frozen=True)
class EpisodeEnd:
    """An episode has ended.

    Attributes:
        episode: The episode.
        success: Whether the task was solved.
        seconds: Wall time.
        elsewhere: Whether a command other than this one planned the episode.
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


Event = Started | BlockStarted | Preparing | BlocksWait | EpisodeEnd | SettingFailed
OnEvent = Callable[[Event], None]


def work_on(study: Study, run_id: str, on_event: OnEvent, save: Save) -> None:
    """Run blocks (groups of episodes) that a sweep of the study has queued, until none is left. For `kerv work`.

    Args:
        study: The study.
        run_id: Only blocks of the command with this id. If empty, blocks of any command.
        on_event: Called with each event, to show progress.
        save: Writes the recording (.rrd file) of an episode.

    Raises:
        UsageError: The study is not in the database, or its device is not on this machine.
        CheckpointError: Weights or data in this results folder differ from those with which the study was planned.
        StorageError: The disk is full or not writable, or the database does not answer.
    """
    if not run_id:  # a sweep of this machine has checked its settings
        study = study.load()
        for setting in study.settings:
            set_up(setting.on(study.tasks[0]).runtime)
            checked(setting, study.tasks, str(study.database.results))
    try:
        work(Queue(study, run_id), EpisodeRunner(study.rollouts, save), on_event)
    finally:
        close_worlds()


def checked(setting: Setting, tasks: list[str], results: str) -> Setting:
    """Check that the weights and data that a stored setting uses are still the same.

    Args:
        setting: The stored setting.
        tasks: Names of the tasks on which it will run.
        results: The results folder in which it will run.

    Returns:
        The setting, changed to run in `results`.

    Raises:
        CheckpointError: The weights or data of the setting have changed.
    """
    here = replace(setting, settings={**setting.settings, "results": results})
    identity = check(here.on(*tasks))
    for kind in setting.identity.keys() | identity.keys():
        before, after = setting.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and before != after:
            raise CheckpointError(
                f"the {kind} of {setting.label} has changed from {before[:12]} to {after[:12]}: it cannot run again"
            )
    return replace(here, identity=identity)


def work(queue: Queue, prepare: Prepare, on_event: OnEvent = lambda event: None) -> None:
    """Claim and run the blocks (groups of episodes) of a queue, one after another, until none is left.

    If a setting fails, the failure is reported and the other settings go on. While other workers run all blocks that
    are left, wait: if one of these workers dies, its block is free again.

    Args:
        queue: The blocks.
        prepare: Builds a setting's decoder for a task.
        on_event: Called with each event, to show progress.

    Raises:
        StorageError: The disk is full or not writable, or the database did not answer for two minutes.
        KervError: The blocks were planned by another version of kerv.
    """
    load, has_waited, ended = load_per_core(), False, None
    with queue.beating():
        while True:
            claim = patiently(queue.claim, ended)
            if claim is not None:
                ended = claim if _Attempt(queue, claim, prepare, on_event, load).run() else None
                continue
            ended, (left, _) = None, patiently(queue.left)
            if left and not has_waited:
                has_waited = True
                on_event(BlocksWait())
            while left:
                time.sleep(POLL_SECONDS)
                left, free = patiently(queue.left)
                if free:
                    break
            else:
                return


def load_per_core() -> float:
    """Return the load average of this machine per core."""
    return round(os.getloadavg()[0] / (os.cpu_count() or 1), 2)


class ClaimLost(KervError):
    """This worker has lost its block (group of episodes): its heartbeat was late, or the study was deleted."""


@dataclass
class Claim:
    """A block (group of episodes) that this worker runs.

    Attributes:
        id: Row number of the block in the queue.
        run: Id of the command that planned the block.
        about: Executor and number of workers of that command.
        block: The episodes to run.
        existing: Episodes of the block that other workers have run since the plan was made, with their rows.
        killer: The episode in which two workers have died. None if there is no such episode.
    """

    id: int
    run: str
    about: dict[str, Any]
    block: Block
    existing: dict[Episode, StoredEpisode]
    killer: Episode | None


class Queue:
    """The queued blocks (groups of episodes) of one study, as one worker sees them.

    Args:
        study: The study.
        run: Only blocks that the command with this id has planned. If empty, all blocks of the study.
    """

    def __init__(self, study: Study, run: str = "") -> None:
        self.study, self.run, self.database = study, run, study.database
        self.worker = worker_id(os.getpid(), secrets.token_hex(4))
        self._claimed: int | None = None
        self._settings: dict[str, Setting] = {}  # settings of earlier blocks, by their hashes

    def fill(self) -> None:
        """Write the planned study and its blocks, in one transaction.

        Blocks of this study that an earlier command has planned are removed if the new plan has all their tasks. They
        stay if that command is still running, or if a worker runs them.
        """
        study = self.study
        about = {"executor": study.runtime.executor, "workers": study.runtime.workers}
        with self.database.writing() as connection:
            number = study.save_in(connection)
            earlier = sa.select(QUEUE).where(QUEUE.c.study_id == number, _is_free(connection))
            for row in connection.execute(earlier).all():
                tasks = {task for _, task, *_ in row.episodes}
                if tasks.issubset(study.tasks) and not is_running(connection, row.run):
                    connection.execute(sa.delete(QUEUE).where(QUEUE.c.id == row.id))
            common = {"study_id": number, "run": self.run, "newest": study.newest, "about": about}
            rows = []
            for position, block in enumerate(study.blocks):
                rows.append({**common, "position": position, "episodes": block.keys})
            if rows:
                connection.execute(sa.insert(QUEUE), rows)

    def claim(self, ended: Claim | None = None) -> Claim | None:
        """Claim the first free block. Return None if none is free now.

        A block is not free while another worker runs one of its episodes, even for another study.

        Args:
            ended: The block that this worker has just finished. It is removed from the queue. None if the worker has
                finished none.
        """
        with self.database.writing() as connection:
            if ended is not None:
                mine = QUEUE.c.id == ended.id, QUEUE.c.worker == self.worker
                connection.execute(sa.delete(QUEUE).where(*mine))
            self._claimed, row = None, self._first_free(connection)
            if row is None:
                return None
            is_dead = row.worker not in (None, self.worker)  # the worker before
            values = {
                "worker": self.worker,
                "heartbeat": clock(connection),
                "died": row.running if is_dead else row.died,
                "running": row.episodes[0],
            }
            connection.execute(sa.update(QUEUE).where(QUEUE.c.id == row.id).values(**values))
        self._claimed = row.id
        killer = row.running if is_dead and row.running == row.died else None
        return self._claim_of(row, killer)

    def _first_free(self, connection: sa.Connection) -> Any:
        """Return the first free row whose episodes no other worker runs. None if there is no such row."""
        query = sa.select(QUEUE).where(self._mine(), self._is_open(connection))
        query = query.order_by(QUEUE.c.position, QUEUE.c.id)
        held: dict[str, set[tuple[Any, ...]]] = {}
        for number in itertools.count():
            row = connection.execute(query.limit(1).offset(number)).first()
            if row is None:
                return None
            if row.run not in held:
                held[row.run] = self._held_outside(connection, row.run)
            if held[row.run].isdisjoint(map(tuple, row.episodes)):
                return row

    def _held_outside(self, connection: sa.Connection, run: str) -> set[tuple[Any, ...]]:
        """Return the keys of episodes that other workers run for commands other than `run`.

        The blocks of one command share no episode, so blocks that `run` planned need no check.
        """
        query = sa.select(QUEUE.c.episodes).join(STUDIES, STUDIES.c.id == QUEUE.c.study_id)
        query = query.where(QUEUE.c.run != run, QUEUE.c.worker != self.worker, ~_is_free(connection))
        # rollouts share no episodes with other studies
        query = query.where(self._mine() if self.study.kind == ROLLOUT else STUDIES.c.kind != ROLLOUT)
        held: set[tuple[Any, ...]] = set()
        for episodes in connection.scalars(query):
            held.update(map(tuple, episodes))
        return held

    def _is_open(self, connection: sa.Connection) -> sa.ColumnElement[bool]:
        # a row of this worker is one whose claim was committed, but the answer was lost
        return sa.or_(_is_free(connection), QUEUE.c.worker == self.worker)

    def _mine(self) -> sa.ColumnElement[bool]:
        study = sa.select(STUDIES.c.id).where(STUDIES.c.name == self.study.name).scalar_subquery()
        of_study: sa.ColumnElement[bool] = QUEUE.c.study_id == study
        return sa.and_(of_study, QUEUE.c.run == self.run) if self.run else of_study

    def _claim_of(self, row: Any, killer: list[Any] | None) -> Claim:
        settings = self._settings_of(row)
        # a setting is missing if another command has planned the study anew, without it
        known = [Episode(settings[work], *rest) for work, *rest in row.episodes if work in settings]
        stored = self.study.stored(row.newest, Block(tuple(known))) if known else {}
        existing, missing = split(known, self.study.block, stored)
        guilty = next((one for one in missing if list(one.key) == killer), None)
        return Claim(row.id, row.run, row.about, Block(tuple(missing)), existing, guilty)

    def _settings_of(self, row: Any) -> dict[str, Setting]:
        """Return the settings of a row's episodes, by their hashes. Their `results` is this process's results folder.

        Raises:
            KervError: This version of kerv computes other results than the version that planned the block.
        """
        works = {work for work, *_ in row.episodes}
        if new := works - self._settings.keys():
            chosen = sa.select(SETTINGS).where(SETTINGS.c.study_id == row.study_id, SETTINGS.c.work.in_(new))
            with self.database.reading() as connection:
                for one in connection.execute(chosen):
                    setting = setting_of(one)
                    if setting.work != one.work:
                        raise KervError(f"{setting.label} was planned by another version of kerv: type the sweep again")
                    plain = {**setting.settings, "results": str(self.database.results)}
                    self._settings[one.work] = replace(setting, settings=plain)
        return {work: self._settings[work] for work in works & self._settings.keys()}

    def hold(self, connection: sa.Connection, claim: Claim, running: Episode | None = None, **values: Any) -> None:
        """Check, in a transaction, that a block still belongs to this worker, and write its heartbeat.

        Args:
            connection: The database, in a transaction.
            claim: The block.
            running: The episode that begins now. If None, the stored episode does not change.
            **values: Further columns of the block's row to write.

        Raises:
            ClaimLost: The block does not belong to this worker any more.
        """
        values |= {"heartbeat": clock(connection)} | ({"running": list(running.key)} if running else {})
        # once lapsed, it stays so: another worker may have claimed a block with the same episodes
        mine = sa.and_(QUEUE.c.id == claim.id, QUEUE.c.worker == self.worker, ~_is_free(connection))
        if not connection.execute(sa.update(QUEUE).where(mine).values(**values)).rowcount:
            raise ClaimLost("the worker was silent for too long, or the study was deleted")

    def begin(self, claim: Claim, one: Episode) -> None:
        """Write into the database that an episode, or the preparation of its setting, begins."""
        with self.database.writing() as connection:
            self.hold(connection, claim, one)

    @contextlib.contextmanager
    def beating(self) -> Iterator[None]:
        """Keep this worker's claim alive during a `with` statement: write its heartbeat every BEAT_SECONDS seconds.

        At the end of the `with` statement, the block of episodes that this worker has claimed becomes free again.
        """
        ended = threading.Event()

        def beat() -> None:
            while not ended.wait(BEAT_SECONDS):
                with contextlib.suppress(KervError):  # the worker itself will meet the same error
                    if self._claimed is not None:
                        with self.database.writing() as connection:
                            mine = sa.and_(QUEUE.c.id == self._claimed, QUEUE.c.worker == self.worker)
                            beaten = sa.update(QUEUE).where(mine, ~_is_free(connection))
                            connection.execute(beaten.values(heartbeat=clock(connection)))

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            with self.database.kept_open():
                yield
        finally:
            ended.set()
            thread.join()
            if self._claimed is not None:
                with contextlib.suppress(StorageError), self.database.writing() as connection:
                    freed = sa.update(QUEUE).where(QUEUE.c.worker == self.worker)
                    connection.execute(freed.values(worker=None, heartbeat=None, running=None))

    def left(self) -> tuple[int, int]:
        """Return the number of blocks that have not ended, and how many of these are free for this worker.

        A block is free unless another worker has claimed it and still writes heartbeats. This method only reads the
        database, so no worker has to wait for it.
        """
        with self.database.reading() as connection:
            is_open = sa.case((self._is_open(connection), 1), else_=0)
            query = sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(is_open), 0)).where(self._mine())
            waiting, free = connection.execute(query).one()
        return int(waiting), int(free)

    def claimed(self) -> list[tuple[int, str]]:
        """Return, for each block that is running, its index in the plan and the name of the worker that runs it."""
        query = sa.select(QUEUE.c.position, QUEUE.c.worker).where(self._mine(), QUEUE.c.worker.is_not(None))
        with self.database.reading() as connection:
            return [(position, worker) for position, worker in connection.execute(query)]

    def lapse(self, pid: int) -> bool:
        """Free at once the blocks that a dead process of this machine had claimed. Return whether it had claimed any.

        Args:
            pid: Id of the process.
        """
        with self.database.writing() as connection:
            died = QUEUE.c.worker.startswith(worker_id(pid), autoescape=True)
            return bool(connection.execute(sa.update(QUEUE).where(died).values(heartbeat=0.0)).rowcount)

    def withdraw(self) -> None:
        """Remove from the queue all blocks that no worker is running."""
        with self.database.writing() as connection:
            connection.execute(sa.delete(QUEUE).where(self._mine(), _is_free(connection)))


def _is_free(connection: sa.Connection) -> sa.ColumnElement[bool]:
    return sa.or_(QUEUE.c.worker.is_(None), QUEUE.c.heartbeat < clock(connection) - LAPSE_SECONDS)


def worker_id(pid: int, more: str = "") -> str:
    """Return the name of a process in the queue.

    Args:
        pid: Id of the process.
        more: Differs between the workers of one process. If empty, return the prefix that their names share.
    """
    return f"{socket.gethostname()}:{pid}:{more}"


def patiently(action: Callable[..., T], *arguments: Any) -> T:
    """Call a function that uses the database. While the database does not answer, call it again.

    Raises:
        StorageError: The database did not answer for PATIENCE_SECONDS. Or calling again would not help, for example
            because the disk is full.
    """
    deadline = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            return action(*arguments)
        except Unanswered as error:
            if time.monotonic() > deadline:
                raise StorageError(f"{error}; finished episodes are kept, the same command goes on") from error
            time.sleep(min(1.0, PATIENCE_SECONDS / 10))


@dataclass(eq=False)
class _Attempt:
    """A block that this process runs.

    Attributes:
        queue: The queue from which the block was claimed.
        claim: The block.
        prepare: Builds a setting's decoder for a task.
        on_event: Called with each event.
        load: Load average per core when the worker began.
        started: Time at which the block began (ISO 8601).
        left: Episodes that have neither ended nor failed, in the order in which they run.
        running: The episode that the database knows to be running.
        failed: Episodes that have failed.
    """

    queue: Queue
    claim: Claim
    prepare: Prepare
    on_event: OnEvent
    load: float
    started: str = field(default_factory=now)
    left: list[Episode] = field(default_factory=list)
    running: Episode | None = None
    failed: list[Episode] = field(default_factory=list)

    def run(self) -> bool:
        """Run the block. Episodes that other workers have run meanwhile are linked to the study instead.

        Returns:
            Whether the block has ended. If not, the claim was lost.
        """
        block = self.claim.block
        self.left = list(block.turns())
        try:
            patiently(self._link_existing)
            if self.claim.killer is not None:
                self._fail(self.claim.killer, SettingFailed("two workers died in this episode"))
            if self.left:
                self.on_event(BlockStarted(block))
                if block.batch > 1:
                    self._run_batch()
                else:
                    self._take_turns()
        except ClaimLost:
            return False
        return True

    def _link_existing(self) -> None:
        if not self.claim.existing:
            return
        with self.queue.database.writing() as connection:
            self.queue.hold(connection, self.claim)
            for one, row in self.claim.existing.items():
                self.queue.study.update(connection, one, episode_id=row.id, error=None)

    def _take_turns(self) -> None:
        runners: dict[str, RunEpisode] = {}
        settings = self.claim.block.settings
        for number, setting in enumerate(settings, 1):
            first = next((one for one in self.left if one.setting.work == setting.work), None)
            if first is not None:
                self.on_event(Preparing(setting, number, len(settings)))
                runner = self._try(first, self.prepare, setting, first.task)
                if runner is not None:
                    runners[setting.work] = runner
        for order, one in enumerate(list(self.left)):
            if one in self.left:
                started = datetime.now(UTC)
                record = self._try(one, runners[one.setting.work], one.seed)
                if record is not None:
                    self._end(one, record, order, started)

    def _try(self, one: Episode, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function for episode `one`. If it raises, report that the setting failed, and return None."""
        self._begin(one)
        try:
            return function(*arguments)
        except Exception as error:  # noqa: BLE001 - the other settings go on
            self._fail(one, failure_of(error))
        return None

    def _begin(self, one: Episode) -> None:
        """Write into the database that an episode, or the preparation of its setting, begins. Write it only once."""
        if one is not self.running:
            patiently(self.queue.begin, self.claim, one)
            self.running = one

    def _run_batch(self) -> None:
        together = self.prepare.together  # type: ignore[attr-defined]
        order = itertools.count()
        self._begin(self.left[0])
        try:
            for one, result in together(list(self.left)):
                if isinstance(result, Exception):
                    self._fail(one, failure_of(result))
                elif one in self.left:
                    started = datetime.now(UTC) - timedelta(seconds=result.wall_seconds)
                    self._end(one, result, next(order), started)
        except (ClaimLost, StorageError):
            raise
        except Exception as error:  # noqa: BLE001 - the other blocks go on
            while self.left:
                self._fail(self.left[0], failure_of(error))

    def _end(self, one: Episode, record: EpisodeRecord, order: int, started: datetime) -> None:
        """Commit an episode that has ended."""
        row = episode_row(record) | {
            "order": order,
            "started": started.isoformat(timespec="milliseconds"),
            "decode_seconds": seconds_blob(decode.seconds for decode in record.decodes),
        }
        decodes = table_blob(decodes_table(record))
        self.running = next((other for other in self.left if other is not one), None)
        patiently(self._write, one, row, decodes)
        self.left.remove(one)
        self.on_event(EpisodeEnd(one, bool(row["success"]), float(row["wall_seconds"])))

    def _write(self, one: Episode, row: dict[str, Any], decodes: bytes) -> None:
        """In one transaction, write an episode and its decodes, and link the episode to the study.

        The same transaction notes which episode is running now.
        """
        block = self._row  # computed before others have to wait
        with self.queue.database.writing() as connection:
            self.queue.hold(connection, self.claim, self.running)
            # it is there already if it was committed, but the answer was lost
            self.queue.study.write(connection, one, block, row, decodes)

    @functools.cached_property
    def _row(self) -> dict[str, Any]:
        """The block's row, which is written with the first episode."""
        claim, runtime = self.claim, self.claim.block.episodes[0].setting.settings["runtime"]
        about = stamp(str(runtime["device"])) | {"engine": ENGINE, "load": self.load} | claim.about
        return {"id": f"{claim.run}-{secrets.token_hex(4)}", "run": claim.run, "seeds": seeds_text(claim.block.seeds),
                "started": self.started, "about": about}  # fmt: skip

    def _fail(self, one: Episode, failure: SettingFailed) -> None:
        """Report that a setting failed on a task. Its remaining episodes in the block will not run.

        Raises:
            StorageError: The setting failed with this error. No other setting could be stored either.
            ClaimLost: The setting failed with this error: the block does not belong to this worker any more.
        """
        if isinstance(failure.error, StorageError | ClaimLost):
            raise failure.error
        same: list[Episode] = []
        others: list[Episode] = []
        for other in self.left:
            alone = isinstance(failure.error, EpisodeError)
            is_same = other is one if alone else (other.setting.work, other.task) == (one.setting.work, one.task)
            (same if is_same else others).append(other)
        if not same:
            return
        same.sort(key=lambda other: other is not one)
        self.failed += same
        patiently(self._write_failure, same, failure)
        self.left = others
        failure = replace(failure, episodes=tuple(same))
        self.on_event(failure)

    def _write_failure(self, failed: list[Episode], failure: SettingFailed) -> None:
        rest = [one.key for one in self.claim.block.episodes if one not in self.failed]
        with self.queue.database.writing() as connection:
            self.queue.hold(connection, self.claim, episodes=rest)
            for one in failed:
                self.queue.study.update(connection, one, error=f"{failure.reason}\n{failure.trace}")


def failure_of(error: BaseException) -> SettingFailed:
    """Return a SettingFailed with the error in one line. For other errors than KervErrors, add type, file and line."""
    trace = "".join(traceback.format_exception(error))
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return SettingFailed(text, trace, error)
    frames = traceback.extract_tb(error.__traceback__)
    line = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return SettingFailed(f"{type(error).__name__}: {text[:200]}{line}", trace)


@dataclass(frozen=True)
class EpisodeRunner:
    """Builds the decoder of a setting and runs its episodes.

    Attributes:
        rollouts: Folder for recordings, one .rrd file per recorded episode.
        save: Writes the recording of an episode.
    """

    rollouts: Path
    save: Save

    def __call__(self, setting: Setting, task: str) -> Callable[[int], EpisodeRecord]:
        """Build the setting's decoder for a task. Return a function that runs the episode with a given seed."""
        runner = Runner(setting.on(task), task)

        def run_episode(seed: int) -> EpisodeRecord:
            record = runner.episode(seed, is_recorded(runner.settings, seed))
            if record.frames:
                self.save(record, self.rollouts / Episode(setting, record.task, seed).recording, setting.label)
            return replace(record, frames={}, places={})

        return run_episode

    def together(self, episodes: Sequence[Episode]) -> Iterator[tuple[Episode, EpisodeRecord | Exception]]:
        """Run episodes of one setting, `rollout.batch` at a time.

        Yield each episode with its record, or with the error that its world raised.
        """
        setting = episodes[0].setting
        settings = setting.on(episodes[0].task)
        requests = [Request(one, one.task, one.seed) for one in episodes]
        for request, result in run_batch(settings, requests):
            yield request.key, result
