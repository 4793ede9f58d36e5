"""The queue: blocks of episodes that wait or run. Workers claim them, wherever they are.

A claim lasts as long as the worker writes its heartbeat. The database's own clock decides, because the clocks of two
machines may differ. Every change is one transaction, and a database has one writer at a time.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import sqlalchemy as sa

from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.lab.database import QUEUE, SETTINGS, STUDIES, Unanswered, clock
from kerv_cli.lab.plan import Block, Episode, Setting, StoredEpisode, split
from kerv_cli.lab.runs import is_running
from kerv_cli.lab.store import ROLLOUT, Study, setting_of

T = TypeVar("T")

BEAT_SECONDS = 5.0
"""Seconds between two heartbeats of a claim."""
LAPSE_SECONDS = 30.0
"""Seconds without a heartbeat after which other workers may claim the block."""
PATIENCE_SECONDS = 120.0
"""Seconds for which a worker tries to reach a database that does not answer."""


class ClaimLost(KervError):
    """This worker has lost its block (group of episodes): its heartbeat was late, or the study was deleted."""


def worker_id(pid: int, more: str = "") -> str:
    """Return the name of a process in the queue.

    Args:
        pid: Id of the process.
        more: Tells the workers of one process apart. Empty: the result is the prefix that all their names share.
    """
    return f"{socket.gethostname()}:{pid}:{more}"


def patiently(action: Callable[[], T]) -> T:
    """Call a function that uses the database. While the database does not answer, call it again.

    Raises:
        StorageError: The database did not answer for PATIENCE_SECONDS. Or calling again would not help, for example
            because the disk is full.
    """
    deadline = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            return action()
        except Unanswered as error:
            if time.monotonic() > deadline:
                raise StorageError(f"{error}; finished episodes are kept, the same command goes on") from error
            time.sleep(min(1.0, PATIENCE_SECONDS / 10))


def enqueue(study: Study, run: str) -> None:
    """Write a planned study and its blocks, in one transaction.

    Blocks of the same tasks that an earlier command has planned are removed, unless that command or a worker still
    runs them.

    Args:
        study: The study with its plan.
        run: Id of the command that made the plan.
    """
    about = {"executor": study.runtime.executor, "workers": study.runtime.workers}
    with study.database.writing() as connection:
        number = study.save_in(connection)
        for row in connection.execute(sa.select(QUEUE).where(QUEUE.c.study_id == number, _is_free(connection))).all():
            tasks = {task for _, task, *_ in row.episodes}
            if tasks.issubset(study.tasks) and not is_running(connection, row.run):
                connection.execute(sa.delete(QUEUE).where(QUEUE.c.id == row.id))
        common = {"study_id": number, "run": run, "newest": study.newest, "about": about}
        rows = [{**common, "position": place, "episodes": block.keys} for place, block in enumerate(study.blocks)]
        if rows:
            connection.execute(sa.insert(QUEUE), rows)


def _is_free(connection: sa.Connection) -> sa.ColumnElement[bool]:
    return sa.or_(QUEUE.c.worker.is_(None), QUEUE.c.heartbeat < clock(connection) - LAPSE_SECONDS)


@dataclass
class Claim:
    """A block (group of episodes) that this worker runs.

    Attributes:
        id: Row number of the block in the queue.
        run: Id of the command that planned it.
        about: Executor and workers of that command.
        block: The episodes to run.
        existing: Episodes of the block that others have run since the plan was made, with their rows.
        killer: The episode in which two workers have died. None: there is none.
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
        run: Only blocks that the command with this id has planned. Empty: all blocks of the study.
    """

    def __init__(self, study: Study, run: str = "") -> None:
        self.study, self.run, self.database = study, run, study.database
        self.worker = worker_id(os.getpid(), secrets.token_hex(4))
        self._claimed: int | None = None
        self._settings: dict[str, Setting] = {}  # those of earlier blocks, by their hashes

    def claim(self, ended: Claim | None = None) -> Claim | None:
        """Claim the first free block. Return None if none is free now.

        A block is not free while another worker runs one of its episodes, for whichever study.

        Args:
            ended: The block that this worker has just finished. It is removed from the queue. None: there is none.
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
        """Return the first free row that nobody else runs an episode of. None: there is none."""
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
        """Return the keys of the episodes that other workers run for other commands. Blocks of one command differ."""
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
        """Return the settings of a row's episodes, by their hashes. They read this process's results folder.

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
            running: The episode that begins now. None: keep the stored one.
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
        """Note that an episode, or the preparation of its setting, begins."""
        with self.database.writing() as connection:
            self.hold(connection, claim, one)

    @contextlib.contextmanager
    def beating(self) -> Iterator[None]:
        """Write the heartbeat of the claimed block during the `with` statement. At its end, free that block."""
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
        """Return how many blocks have not ended, and how many of them nobody has claimed.

        This only reads the database, so no worker has to wait for it.
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
        """Free at once the blocks that a dead process of this machine had claimed. Return whether there were any."""
        with self.database.writing() as connection:
            died = QUEUE.c.worker.startswith(worker_id(pid), autoescape=True)
            return bool(connection.execute(sa.update(QUEUE).where(died).values(heartbeat=0.0)).rowcount)

    def withdraw(self) -> None:
        """Remove the blocks that nobody runs."""
        with self.database.writing() as connection:
            connection.execute(sa.delete(QUEUE).where(self._mine(), _is_free(connection)))
