"""Follow a saved plan until every episode has ended or failed, wherever its workers run."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import sqlalchemy as sa

from kerv_cli.base.durations import count
from kerv_cli.base.errors import Interrupted, KervError, StorageError, UsageError
from kerv_cli.episodes.runner import close_worlds
from kerv_cli.lab.database import EPISODES, SETTINGS, STUDIES, UNFINISHED, WANTED, WORKERS
from kerv_cli.lab.plan import Episode
from kerv_cli.lab.presence import beats
from kerv_cli.lab.queue import Queue, patiently
from kerv_cli.lab.read import counts_of, rows_of
from kerv_cli.lab.runs import Run
from kerv_cli.lab.store import ROLLOUT
from kerv_cli.lab.study import Plan, save, withdraw
from kerv_cli.lab.work import (
    WAITING_SECONDS,
    BlocksWait,
    Counted,
    EpisodeEnd,
    EpisodeRunner,
    Event,
    OnEvent,
    Prepare,
    Save,
    SettingFailed,
    Started,
    load_per_core,
    work,
)
from kerv_cli.lab.workers import workers

FOLLOW_SECONDS = 0.3
"""Seconds between two counts of the episodes that are left."""


@dataclass
class Outcome:
    """Result of a plan. Each episode of the study is in exactly one of the first three lists.

    Attributes:
        done: Episodes that were missing and have been run, by this command or another.
        reused: Episodes that were in the database already.
        failed: Settings that failed, with their episodes.
        seconds: Wall time.
    """

    done: list[Episode] = field(default_factory=list)
    reused: list[Episode] = field(default_factory=list)
    failed: list[SettingFailed] = field(default_factory=list)
    seconds: float = 0.0


@contextlib.contextmanager
def begun(plan: Plan) -> Iterator[Run]:
    """Write the row of a command that runs a plan, for a `with` block.

    If the block raises an exception, what nobody runs is not asked for any more.
    """
    study = plan.study
    with Run(study.database, study.kind, study.name, plan.command, len(plan.to_run), study.kind == ROLLOUT) as run:
        try:
            yield run
        except BaseException as error:
            if not isinstance(error, UsageError):  # that is, the plan was not saved
                with contextlib.suppress(StorageError):
                    withdraw(plan, run.id)
            if not isinstance(error, KeyboardInterrupt):
                raise
            again = (
                "run the same command without rerun=all"
                if plan.anew and study.kind != ROLLOUT
                else "run the same command"
            )
            raise Interrupted(f"interrupted: {_kept(plan)} of {study.name} are kept: {again} to resume") from None
        finally:
            close_worlds()


def run(plan: Plan, on_event: OnEvent = lambda event: None, *, write: Save = lambda *_: None) -> Outcome:
    """Save a plan, and run its missing episodes. Each episode is in the database as soon as it ends.

    Args:
        plan: The plan.
        on_event: Called with each event, to show progress.
        write: Writes the recording (.rrd file) of an episode. The default writes nothing.
    """

    def forward(event: Event) -> None:
        if isinstance(event, SettingFailed) and plan.study.kind == ROLLOUT:
            raise event.error or KervError(event.reason)
        on_event(event)

    with begun(plan) as record:
        save(plan, record.id)
        with workers(plan, record.id) as tend:
            return follow(plan, record, tend, EpisodeRunner(plan.study.rollouts, write), forward)


def _kept(plan: Plan) -> str:
    try:
        done, total = counts_of(plan.study)
        return f"{done} of {count(total or len(plan.study.episodes), 'episode')}"  # its plan may not be written yet
    except StorageError:
        return "all complete episodes"


def follow(plan: Plan, record: Run, tend: Callable[[], object], prepare: Prepare, on_event: OnEvent) -> Outcome:
    """Wait until no episode of a saved plan is left. With one worker, this process is the worker.

    Args:
        plan: The plan.
        record: The row of this command.
        tend: What `workers` yields.
        prepare: Builds a setting's decoder for a task. Used in this process only.
        on_event: Called with each event, to show progress.
    """
    began, counted = time.perf_counter(), 0.0
    is_timed = any(block.batch == 1 for block in plan.blocks)
    on_event(Started(len(plan.to_run), len(plan.existing), load_per_core() if is_timed else 0.0))
    queue = Queue(plan.study, record.worker, record.id)

    def left() -> int:
        nonlocal counted
        waiting, counted = patiently(_left, plan, queue.number), time.monotonic()
        on_event(Counted(waiting))
        record.beat(max(0, len(plan.to_run) - waiting))
        return waiting

    def see(event: Event) -> None:
        on_event(event)
        if isinstance(event, EpisodeEnd) and time.monotonic() - counted > FOLLOW_SECONDS:
            left()

    if plan.runtime.workers == 1 and not plan.is_elsewhere:
        work(queue, prepare, see, lambda: not left())
    told = time.monotonic()
    while waiting := left():
        tend()
        if time.monotonic() - told > WAITING_SECONDS:
            told = time.monotonic()
            if not patiently(_alive, plan, queue.number):
                on_event(BlocksWait(waiting, has_workers=False))
        time.sleep(FOLLOW_SECONDS)
    return _outcome(plan, queue.number, time.perf_counter() - began)


def _left(plan: Plan, number: int) -> int:
    """Return the number of unfinished episodes of a plan. Labels of one result share its episodes."""
    study = plan.study
    seeds = [one.seed for one in study.episodes]
    mine = WANTED.c.task.in_(study.tasks), WANTED.c.seed.between(min(seeds, default=0), max(seeds, default=-1))
    query = sa.select(SETTINGS.c.work, WANTED.c.task, WANTED.c.seed).distinct().select_from(WANTED.join(SETTINGS))
    query = query.where(WANTED.c.study_id == number, UNFINISHED, *mine, SETTINGS.c.label.in_(study.labels))
    with study.database.reading() as connection:
        return connection.scalar(sa.select(sa.func.count()).select_from(query.subquery())) or 0


def _alive(plan: Plan, number: int) -> bool:
    with plan.study.database.reading() as connection:
        alive = sa.select(WORKERS.c.name).where(beats(connection))
        query = sa.select(sa.func.count()).where(WANTED.c.study_id == number, UNFINISHED)
        return bool(connection.scalar(query.where(WANTED.c.worker.in_(alive))))


def _outcome(plan: Plan, number: int, seconds: float) -> Outcome:
    study, outcome = plan.study, Outcome(seconds=seconds)
    with study.database.reading() as connection:
        rows = {(row.label, row.task, row.seed): row for row in rows_of(connection, study.name)}
        is_there = connection.scalar(sa.select(STUDIES.c.id).where(STUDIES.c.id == number)) is not None
    if not is_there:
        raise KervError(f"study {study.name} was deleted while it ran: run the same command to start it again")
    failed = dict[tuple[str, str, str], dict[Episode, None]]()
    shown = {one.key: one for one in plan.missing}
    for one in study.episodes:
        row = rows.get((one.setting.label, one.task, one.seed))
        if row is not None and row.episode_id is not None:
            (outcome.reused if one in plan.existing else outcome.done).append(one)
        else:
            error = (row and row.error) or "another command took it out of the study: run the same command again"
            failed.setdefault((one.setting.work, one.task, error), {})[one] = None
    outcome.done = [one for one in outcome.done if shown.get(one.key, one) is one]
    for (_, _, error), episodes in failed.items():
        reason, _, trace = error.partition("\n")
        outcome.failed.append(SettingFailed(reason, trace, episodes=tuple(episodes)))
    return outcome


class TimeLeft:
    """Estimates how long the missing episodes of a plan take: at first from stored episodes, then from their pace.

    Args:
        plan: The plan.
        guess: Seconds per episode if none of the study's settings has a stored one.
    """

    def __init__(self, plan: Plan, guess: float) -> None:
        works = {setting.work for setting in plan.study.settings}
        query = sa.select(sa.func.avg(EPISODES.c.wall_seconds), sa.func.count(EPISODES.c.wall_seconds))
        with plan.study.database.reading() as connection:
            mean, stored = connection.execute(query.where(EPISODES.c.work.in_(works))).one()
        self._total, self._began = len(plan.to_run), time.monotonic()
        self.seconds = self._total * (mean or guess) / max(1, min(plan.runtime.workers, len(plan.blocks)))
        self.source = (
            f"measured on {count(stored, 'stored episode')}" if stored else f"a guess of {guess:g} s per episode"
        )

    def see(self, event: Event) -> None:
        """Correct the estimate by the number of episodes that are left."""
        if isinstance(event, Counted) and event.left < self._total:
            self.seconds = (time.monotonic() - self._began) * event.left / (self._total - event.left)
