"""The queue of a study, as one worker sees it: claim a block, and write which episodes begin, end or fail.

Every method is one transaction, and a database has one writer at a time. A claim lasts as long as the worker's
heartbeat, and every write checks that the rows still belong to the worker.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import sqlalchemy as sa

from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.episodes.identity import Setting
from kerv_cli.lab.database import (
    BLOCKS,
    DECODES,
    EPISODES,
    PLANNED,
    RUNS,
    SETTINGS,
    STUDIES,
    UNFINISHED,
    WANTED,
    WORKERS,
    Unanswered,
)
from kerv_cli.lab.plan import Block, Episode
from kerv_cli.lab.runs import beats
from kerv_cli.lab.store import IS_NO_ROLLOUT, RAN, ROLLOUT, Study, setting_of

T = TypeVar("T")

MOST_DEATHS = 3
"""If this many workers have died during an episode, its setting fails in the block."""
PATIENCE_SECONDS = 120.0
"""Seconds for which a worker tries to reach a database that does not answer."""


class ClaimLost(KervError):
    """An episode does not belong to this worker any more: its heartbeat was late, or the study was deleted."""


@dataclass(frozen=True)
class Claim:
    """Episodes that this worker runs.

    Attributes:
        run: Id of the command under which the episodes are stored.
        block: The episodes.
        deadly: An episode in which MOST_DEATHS workers have died. None if there is none.
    """

    run: str
    block: Block
    deadly: Episode | None = None


class Queue:
    """The unfinished rows of a study, for one worker.

    Args:
        study: The study. Only its database, name and kind matter.
        worker: Name of the worker in the table WORKERS.
        run: Id of the command for which the worker runs episodes. If empty, the study's newest command.
    """

    def __init__(self, study: Study, worker: str, run: str = "") -> None:
        self.study, self.worker, self.run, self.database = study, worker, run, study.database
        with self.database.reading() as connection:
            self.number = connection.scalar(sa.select(STUDIES.c.id).where(STUDIES.c.name == study.name)) or 0
        self._of_study = sa.and_(WANTED.c.study_id == self.number, UNFINISHED)
        self._settings: dict[int, Setting] = {}

    def claim(self) -> Claim | None:
        """Claim the free rows of the first block that has some. Return None if no row is free now.

        If another study has stored a row's episode meanwhile, the row is linked to that episode, and this worker does
        not run it. So the block of the claim may be empty.
        """
        with self.database.writing() as connection:
            others = self._others(connection)
            # a row of this worker is one whose claim was committed, but the answer was lost
            is_open = sa.and_(self._of_study, sa.or_(WANTED.c.worker.is_(None), WANTED.c.worker.not_in(others)))
            first = sa.select(WANTED.c.block).where(is_open, WANTED.c.block.not_in(self._busy(connection, others)))
            number = first.order_by(WANTED.c.block).limit(1).correlate(None).scalar_subquery()
            taken = sa.update(WANTED).where(is_open, WANTED.c.block == number)
            rows = connection.execute(taken.values(worker=self.worker).returning(WANTED)).all()
            if not rows:
                return None
            settings = self._settings_of(connection, rows)
            ordered = [number for number in {row.setting_id for row in rows} if settings[number].depends_on_order]
            if ordered:  # if the block was begun, they run again from its first episode on
                begun = WANTED.c.study_id == self.number, WANTED.c.block == rows[0].block
                again = sa.update(WANTED).where(*begun, WANTED.c.setting_id.in_(ordered), WANTED.c.error.is_(None))
                values = {"worker": self.worker, "episode_id": None, "attempts": 0}
                again = again.where(WANTED.c.episode_id.is_not(None)).values(**values)
                rows = [*rows, *connection.execute(again.returning(WANTED)).all()]
            linked = self._link(connection, ordered)
            newest = sa.select(RUNS.c.id).order_by(RUNS.c.started.desc(), RUNS.c.id.desc()).limit(1)
            newest = newest.where(RUNS.c.kind == self.study.kind, RUNS.c.name == self.study.name)
            run = self.run or connection.scalar(newest) or ""
        episodes, deadly = dict[Any, Episode](), None
        for row in sorted(rows, key=lambda row: row.position):
            one = Episode(settings[row.setting_id], row.task, row.seed)
            if (row.setting_id, row.task, row.seed) not in linked:
                one = episodes.setdefault(one.key, one)
                deadly = one if row.attempts >= MOST_DEATHS else deadly
        return Claim(run, Block(tuple(episodes.values())), deadly)

    def _others(self, connection: sa.Connection) -> Sequence[str]:
        return connection.scalars(
            sa.select(WORKERS.c.name).where(beats(connection), WORKERS.c.name != self.worker)
        ).all()

    def _busy(self, connection: sa.Connection, others: Sequence[str]) -> Sequence[int]:
        """Return the blocks with an episode that a worker runs for another study. Its result will be reused."""
        episode = SETTINGS.c.work, WANTED.c.task, WANTED.c.seed
        query = sa.select(*episode).select_from(PLANNED).where(WANTED.c.worker.in_(others), UNFINISHED)
        query = query.where(STUDIES.c.kind != ROLLOUT, STUDIES.c.id != self.number)
        # rollouts share no episodes with other studies
        if self.study.kind == ROLLOUT or connection.execute(query.limit(1)).first() is None:
            return []
        is_held = sa.tuple_(*episode).in_(query.correlate(None))  # a list might have more values than SQL may bind
        mine = sa.select(WANTED.c.block).distinct().select_from(PLANNED).where(self._of_study, is_held)
        return connection.scalars(mine).all()

    def _settings_of(self, connection: sa.Connection, rows: Sequence[Any]) -> Mapping[int, Setting]:
        if not self._settings.keys() >= {row.setting_id for row in rows}:
            for one in connection.execute(sa.select(SETTINGS).where(SETTINGS.c.study_id == self.number)):
                setting = setting_of(one)
                if setting.work != one.work:
                    raise KervError(f"{setting.label} was planned by another version of kerv: type the sweep again")
                plain = {**setting.settings, "results": str(self.database.results)}
                self._settings[one.id] = replace(setting, settings=plain)
        return self._settings

    def _link(self, connection: sa.Connection, ordered: Sequence[int]) -> set[Any]:
        """Link claimed rows to episodes that other studies have stored. Return the keys of these rows."""
        same = EPISODES.c.work == SETTINGS.c.work, EPISODES.c.task == WANTED.c.task, EPISODES.c.seed == WANTED.c.seed
        newest = sa.select(sa.func.max(EPISODES.c.id)).select_from(RAN.join(SETTINGS, sa.true()))
        newest = newest.where(SETTINGS.c.id == WANTED.c.setting_id, *same, IS_NO_ROLLOUT).correlate(WANTED)
        mine = WANTED.c.worker == self.worker, self._of_study, ~WANTED.c.anew, WANTED.c.setting_id.not_in(ordered)
        found = sa.update(WANTED).where(*mine).values(episode_id=newest.scalar_subquery())
        rows = connection.execute(found.returning(WANTED)).all()
        return {(row.setting_id, row.task, row.seed) for row in rows if row.episode_id is not None}

    def _rows(self, one: Episode) -> sa.ColumnElement[bool]:
        ids = [number for number, setting in self._settings.items() if setting.work == one.setting.work]
        of_study = WANTED.c.study_id == self.number
        return sa.and_(of_study, WANTED.c.setting_id.in_(ids), WANTED.c.task == one.task, WANTED.c.seed == one.seed)

    def _change(self, connection: sa.Connection, one: Episode, is_mine: Any = UNFINISHED, **values: Any) -> None:
        mine = self._rows(one), WANTED.c.worker == self.worker, is_mine
        if not connection.execute(sa.update(WANTED).where(*mine).values(**values)).rowcount:
            raise ClaimLost("the worker was silent for too long, or the study was deleted")

    def begin(self, one: Episode, before: Episode | None = None) -> None:
        """Note that an episode, or the preparation of its setting, begins. The note of `before` is taken back."""
        with self.database.writing() as connection:
            if before is not None:
                self._change(connection, before, attempts=WANTED.c.attempts - 1)
            self._change(connection, one, attempts=WANTED.c.attempts + 1)

    def survive(self, one: Episode) -> None:
        """Take back one counted death: this worker lives, although another worker has claimed its episode meanwhile."""
        with self.database.writing() as connection:
            counted = sa.update(WANTED).where(self._rows(one), UNFINISHED, WANTED.c.attempts > 0)
            connection.execute(counted.values(attempts=WANTED.c.attempts - 1))

    def write(
        self, one: Episode, block: Mapping[str, Any], row: Mapping[str, Any], decodes: bytes, then: Episode | None
    ) -> None:
        """Write an episode that has ended, and note that another begins.

        Args:
            one: The episode.
            block: Row of its block.
            row: Columns of the table `episodes`.
            decodes: The episode's decodes, as the bytes of a Parquet file.
            then: The episode that begins now. None if there is none.
        """
        with self.database.writing() as connection:
            own = dict(zip(("work", "task", "seed"), one.key, strict=True)) | {"block": block["id"]}
            number = connection.scalar(sa.select(EPISODES.c.id).filter_by(**own))
            if number is None:  # otherwise it was committed, but the answer was lost
                if connection.scalar(sa.select(BLOCKS.c.id).filter_by(id=block["id"])) is None:
                    connection.execute(sa.insert(BLOCKS).values(**block))
                number = connection.scalar(sa.insert(EPISODES).values({**row, **own}).returning(EPISODES.c.id))
                connection.execute(sa.insert(DECODES).values(episode_id=number, parquet=decodes))
            is_mine = sa.or_(WANTED.c.episode_id.is_(None), WANTED.c.episode_id == number)
            self._change(connection, one, is_mine, episode_id=number, error=None, attempts=0, anew=False)
            if then is not None:
                self._change(connection, then, attempts=WANTED.c.attempts + 1)

    def fail(self, episodes: Sequence[Episode], error: str) -> None:
        """Write why episodes of this worker failed or will not run."""
        with self.database.writing() as connection:
            for one in episodes:
                self._change(connection, one, sa.true(), error=error, attempts=0)

    def left(self, plan: Study | None = None) -> int:
        """Return the number of unfinished episodes of the study. With `plan`, count only the episodes of this plan."""
        query = sa.select(SETTINGS.c.work, WANTED.c.task, WANTED.c.seed).distinct().select_from(WANTED.join(SETTINGS))
        if plan is not None:
            seeds = [one.seed for one in plan.episodes]
            of_plan = WANTED.c.task.in_(plan.tasks), WANTED.c.seed.between(min(seeds), max(seeds))
            query = query.where(*of_plan, SETTINGS.c.label.in_(plan.labels))
        with self.database.reading() as connection:
            counted = sa.select(sa.func.count()).select_from(query.where(self._of_study).subquery())
            return connection.scalar(counted) or 0

    def has_workers(self) -> bool:
        """Return whether another worker runs an episode of the study."""
        with self.database.reading() as connection:
            held = self._of_study, WANTED.c.worker.in_(self._others(connection))
            return bool(connection.scalar(sa.select(sa.exists().where(*held))))


def patiently(action: Callable[..., T], *arguments: Any) -> T:
    """Call a function that uses the database. While the database does not answer, call it again."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            return action(*arguments)
        except Unanswered as error:
            if time.monotonic() > deadline:
                raise StorageError(f"{error}; finished episodes are kept, the same command goes on") from error
            time.sleep(min(1.0, PATIENCE_SECONDS / 10))
