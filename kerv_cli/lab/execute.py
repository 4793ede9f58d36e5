"""Runs the missing episodes of a plan through an executor, and saves each episode when it ends.

Episodes run in blocks. Within a block the settings take turns in one process, episode by episode. Workers send their
episodes to the process that began the run. Only this process writes to the database. If it is killed, at most the
episodes that are running are lost.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import os
import pickle
import secrets
import shutil
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.base.files import storage_errors, visible
from kerv_cli.base.leftovers import clean, temporary_beside
from kerv_cli.base.registry import find
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.identity import ENGINE, code_hash
from kerv_cli.episodes.rows import decodes_table, episode_row, seconds_blob, table_blob
from kerv_cli.lab import events
from kerv_cli.lab.database import BLOCKS, STUDIES, now
from kerv_cli.lab.executors import Executor, WorkerLost, check_executor
from kerv_cli.lab.plan import Block, Episode, Setting, seeds_text, split
from kerv_cli.lab.runs import Run, is_running
from kerv_cli.lab.store import Plan, insert_episode, stored_episodes
from kerv_cli.targets.provenance import stamp

_POLL_SECONDS = 0.2
LATE_SECONDS = 70.0
"""A network folder may show a worker's message this many seconds late (NFS caches a folder's list for up to 60 s)."""

RunEpisode = Callable[[int], EpisodeRecord]
"""Function that runs the episode with a given seed."""

Prepare = Callable[[Setting, str], RunEpisode]
"""Function that builds and warms up a setting's decoder for a task. Picklable. Its method `together` runs batches."""


@dataclass(frozen=True)
class Message:
    """Message from a worker: an episode began, ended or failed. If `row` and `failure` are empty, it began.

    Attributes:
        index: Index of the episode in its block.
        row: Columns of the table `episodes`, if the episode ended.
        decodes: The episode's decodes as a Parquet file, if it ended.
        about: The worker's machine and versions, if the episode ended.
        failure: The error, if the episode failed.
    """

    index: int
    row: dict[str, Any] = field(default_factory=dict)
    decodes: bytes = b""
    about: dict[str, Any] = field(default_factory=dict)
    failure: events.SettingFailed | None = None


Send = Callable[[Message], None]


@dataclass(frozen=True)
class Spool:
    """Sends messages to another process as files in a folder. Picklable."""

    folder: Path

    def __call__(self, message: Message) -> None:
        """Write a message.

        Raises:
            StorageError: The disk is full or not writable.
        """
        path = self.folder / f"{time.time_ns():020d}"
        with storage_errors(path):
            temporary = temporary_beside(path)
            temporary.write_bytes(pickle.dumps(message))
            os.replace(temporary, path)

    def take(self) -> Iterator[Message]:
        """Yield all messages, oldest first, and delete each."""
        for path in visible(self.folder):
            message = pickle.loads(path.read_bytes())
            path.unlink()
            yield message


@dataclass(frozen=True)
class BlockRun:
    """The function that an executor calls to run one block of episodes. Picklable if `send` is a `Spool`."""

    block: Block
    prepare: Prepare
    send: Send

    def __call__(self) -> None:
        """Run the block, and send a message for each episode that ends."""
        if self.block.batch > 1:
            self._run_batch()
        else:
            self._take_turns()

    def _take_turns(self) -> None:
        runners: dict[str, RunEpisode] = {}
        for setting in self.block.settings:
            first = next(one for one in self.block.episodes if one.setting.work == setting.work)
            runner = self._try(first, functools.partial(self.prepare, setting, first.task))
            if runner is not None:
                runners[setting.work] = runner
        for order, one in enumerate(self.block.turns()):
            if one.setting.work in runners:
                run = functools.partial(self._run, one, order, runners[one.setting.work])
                message = self._try(one, run)
                if message is None:
                    del runners[one.setting.work]
                else:
                    self.send(message)

    def _try(self, one: Episode, function: Callable[[], Any]) -> Any:
        """Call a function for episode `one`. If it fails, send the error and return None."""
        self.send(Message(self.block.episodes.index(one)))
        try:
            return function()
        except Exception as error:  # noqa: BLE001 - the other settings go on
            failure = failure_of(error)
        self.send(Message(self.block.episodes.index(one), failure=failure))
        return None

    def _run(self, one: Episode, order: int, run: RunEpisode) -> Message:
        started = datetime.now(UTC)
        return self._ended(one, run(one.seed), order, started)

    def _run_batch(self) -> None:
        self.send(Message(0))
        runner: Any = self.prepare
        failed: set[str] = set()
        order = itertools.count()
        try:
            for one, result in runner.together(self.block.episodes):
                if isinstance(result, Exception):
                    failed.add(one.task)
                    self.send(Message(self.block.episodes.index(one), failure=failure_of(result)))
                elif one.task not in failed:
                    started = datetime.now(UTC) - timedelta(seconds=result.wall_seconds)
                    self.send(self._ended(one, result, next(order), started))
        except Exception as error:  # noqa: BLE001 - the other blocks go on
            for index in range(len(self.block.episodes)):
                self.send(Message(index, failure=failure_of(error)))

    def _ended(self, one: Episode, record: EpisodeRecord, order: int, started: datetime) -> Message:
        row = episode_row(record) | {
            "order": order,
            "started": started.isoformat(timespec="milliseconds"),
            "decode_seconds": seconds_blob(decode.seconds for decode in record.decodes),
        }
        about = stamp(str(one.setting.settings["runtime"]["device"]))
        return Message(self.block.episodes.index(one), row, table_blob(decodes_table(record)), about)


def failure_of(error: BaseException) -> events.SettingFailed:
    """Describe an error in one line. For errors that are not KervErrors, add the type, file and line."""
    trace = "".join(traceback.format_exception(error))
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return events.SettingFailed(text, trace, error)
    frames = traceback.extract_tb(error.__traceback__)
    line = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return events.SettingFailed(f"{type(error).__name__}: {text[:200]}{line}", trace)


def execute(plan: Plan, prepare: Prepare, record: Run, on_event: events.OnEvent = lambda event: None) -> events.Outcome:
    """Run the missing episodes of a plan, block by block.

    If a setting fails, or its worker is killed, it is reported as failed and the other settings go on. If another sweep
    is running the same episodes, wait for it. With one local worker everything runs in this process.

    Args:
        plan: Which episodes to run. Its study is in the database.
        prepare: Builds a setting's decoder for a task.
        record: The database row of this command.
        on_event: Called with each event, to show progress.

    Raises:
        StorageError: The disk is full or not writable.
        UsageError: The executor cannot be used.
    """
    return _Sweep(plan, prepare, record, on_event).run()


@dataclass(eq=False)
class _Attempt:
    """A block of episodes that is running.

    Attributes:
        block: The block.
        id: Id of its row in the database.
        spool: Where its worker writes messages.
        last: The episode that began last.
        future: Completed when the block has ended.
        ended: Episodes that ended.
        failed: Episodes that failed, or that will not run because their setting failed.
    """

    block: Block
    id: str
    spool: Spool
    last: Episode
    future: Future[None] = field(default_factory=Future)
    ended: set[Episode] = field(default_factory=set)
    failed: set[Episode] = field(default_factory=set)

    @property
    def rest(self) -> list[Episode]:
        return [one for one in self.block.episodes if one not in self.ended and one not in self.failed]


class _Sweep:
    """State of one call of `execute`."""

    def __init__(self, plan: Plan, prepare: Prepare, record: Run, on_event: events.OnEvent) -> None:
        self.plan, self.prepare, self.record, self.on_event = plan, prepare, record, on_event
        self.database, self.runtime = plan.store.database, plan.runtime
        self.outcome = events.Outcome(reused=list(plan.existing))
        self.waiting: deque[Block] = deque(plan.blocks())
        self.elsewhere: list[Block] = []  # another sweep is running them
        self.attempts: list[_Attempt] = []
        self.is_here = self.runtime.executor == "local" and self.runtime.workers == 1
        self.spool = temporary_beside(self.database.results / "spool")
        self.load = round(os.getloadavg()[0] / (os.cpu_count() or 1), 2)  # per core, at the start

    def run(self) -> events.Outcome:
        clock, to_run = time.perf_counter(), self.plan.to_run
        options = check_executor(self.runtime)
        clean(self.database.results)  # remove messages to processes that were killed
        self.record.beat(0, len(to_run))
        is_timed = any(block.batch == 1 for block in self.waiting)
        self.on_event(events.Started(len(to_run), len(self.plan.existing), self.load if is_timed else 0.0))
        if to_run:
            threads = max(one.setting.settings["runtime"]["threads"] for one in to_run)
            part = find("executor", self.runtime.executor)
            self._run_blocks(part.built(options, self.runtime.workers, threads, self.plan.store.root / "jobs"))
        self.outcome.seconds = time.perf_counter() - clock
        return self.outcome

    def _run_blocks(self, executor: Executor) -> None:
        """Give blocks to the executor, and keep all of its workers busy, until every block has ended."""
        finished = False
        try:
            while self.waiting or self.attempts or self.elsewhere:
                while self.waiting and len(self.attempts) < executor.slots:
                    self._begin(executor, self.waiting.popleft())
                futures = [attempt.future for attempt in self.attempts]
                done = wait(futures, timeout=_POLL_SECONDS, return_when=FIRST_COMPLETED).done
                for attempt in list(self.attempts):
                    self._take(attempt)
                    if attempt.future in done:
                        self._end(attempt)
                if self.elsewhere and not self.waiting and not self.attempts:
                    time.sleep(5 * _POLL_SECONDS)
                    self.waiting.extend(self.elsewhere)
                    self.elsewhere = []
            finished = True
        finally:
            executor.close(abandon=not finished)
            for attempt in self.attempts:
                with contextlib.suppress(KervError):  # show the first error only
                    self._take(attempt)
                self._release(attempt)
            shutil.rmtree(self.spool, ignore_errors=True)

    def _begin(self, executor: Executor, block: Block) -> None:
        """Reserve a block of episodes for this run, and give it to the executor.

        If another run has reserved it, try again later. Episodes that another run has finished since the plan are left
        out.
        """
        name = f"{self.record.id}-{secrets.token_hex(4)}"
        if not self._claim(block, name):
            self.elsewhere.append(block)
            self.on_event(events.BlockWaits(block))
            return
        attempt = _Attempt(block, name, Spool(self.spool / name), block.episodes[0])
        self.attempts.append(attempt)
        if not self._leave_out_existing(attempt):
            self._release(attempt)
            return
        self.on_event(events.BlockStarted(attempt.block))
        send: Send = functools.partial(self._receive, attempt) if self.is_here else attempt.spool
        if not self.is_here:
            with storage_errors(attempt.spool.folder):
                attempt.spool.folder.mkdir(parents=True)
        attempt.future = executor.submit(BlockRun(attempt.block, self.prepare, send))

    def _claim(self, block: Block, name: str) -> bool:
        """Write a row that reserves the block's episodes for this run.

        Returns:
            False if another run that is alive has reserved one of these episodes for the same study.
        """
        episodes = {"/".join(map(str, (self.plan.study.name, *one.key))) for one in block.episodes}
        with self.database.writing() as connection:
            for row in connection.execute(sa.select(BLOCKS).where(BLOCKS.c.claim.is_not(None))).all():
                if episodes.isdisjoint(json.loads(row.claim)):
                    continue
                if row.run != self.record.id and is_running(connection, row.run):
                    return False
                connection.execute(sa.update(BLOCKS).where(BLOCKS.c.id == row.id).values(claim=None))
            connection.execute(
                sa.insert(BLOCKS).values(
                    id=name, run=self.record.id, claim=json.dumps(sorted(episodes)), seeds=seeds_text(block.seeds),
                    started=now(), code=code_hash(), about={},
                )
            )  # fmt: skip
        return True

    def _leave_out_existing(self, attempt: _Attempt) -> bool:
        """Remove from a block the episodes that other sweeps have run since the plan was made.

        Returns:
            Whether any episodes are left.
        """
        study = replace(self.plan.study, settings=attempt.block.settings, episodes=attempt.block.episodes)
        existing, missing = split(study, stored_episodes(self.database, study, newer_than=self.plan.newest))
        if existing:
            with self.database.writing() as connection:
                for one, row in existing.items():
                    connection.execute(self.plan.store.update_of(one).values(episode_id=row.id, error=None))
        for one in existing:
            self.outcome.reused.append(one)
            self.on_event(events.EpisodeEnd(one, elsewhere=True))
        attempt.block = Block(tuple(missing))
        return bool(missing)

    def _take(self, attempt: _Attempt) -> None:
        for message in attempt.spool.take():
            self._receive(attempt, message)

    def _receive(self, attempt: _Attempt, message: Message) -> None:
        attempt.last = one = attempt.block.episodes[message.index]
        if message.failure is not None:
            self._fail(attempt, one, message.failure)
        elif message.row:
            self._write(attempt, one, message)
            attempt.ended.add(one)
            self.outcome.done.append(one)
            self.on_event(events.EpisodeEnd(one, bool(message.row["success"]), float(message.row["wall_seconds"])))
            self.record.beat(len(self.outcome.done))

    def _write(self, attempt: _Attempt, one: Episode, message: Message) -> None:
        """Write an episode and its decodes to the database, and link the episode to the study."""
        work, task, seed, repeat = one.key
        row = {"work": work, "task": task, "seed": seed, "repeat": repeat, "block": attempt.id, **message.row}
        about = {"engine": ENGINE, "executor": self.runtime.executor, "workers": self.runtime.workers}
        about["load"] = self.load
        with self.database.writing() as connection:
            if not attempt.ended:
                here = sa.update(BLOCKS).where(BLOCKS.c.id == attempt.id)
                connection.execute(here.values(about=message.about | about))
            number = insert_episode(connection, row, message.decodes)
            connection.execute(self.plan.store.update_of(one).values(episode_id=number, error=None))
            name = self.plan.study.name  # another sweep may have planned the study anew, without this episode
            if connection.scalar(sa.select(STUDIES.c.id).where(STUDIES.c.name == name)) is None:
                raise KervError(f"study {name} was deleted while it ran: run the same command to start it again")

    def _fail(self, attempt: _Attempt, one: Episode, failure: events.SettingFailed) -> None:
        """Note that a setting failed on a task. Its remaining episodes in the block will not run."""
        if isinstance(failure.error, StorageError):
            raise failure.error
        same = [other for other in attempt.rest if (other.setting.work, other.task) == (one.setting.work, one.task)]
        if not same:
            return
        same.sort(key=lambda other: other is not one)
        attempt.failed.update(same)
        with self.database.writing() as connection:
            for other in same:
                update = self.plan.store.update_of(other).values(error=failure.trace or failure.reason)
                connection.execute(update)
        failure = replace(failure, episodes=tuple(same))
        self.outcome.failed.append(failure)
        self.on_event(failure)

    def _end(self, attempt: _Attempt) -> None:
        """End a block: read its last messages, and queue the remaining episodes again if its worker was lost."""
        self._take(attempt)
        error = attempt.future.exception()
        deadline = time.monotonic() + LATE_SECONDS
        while error is None and attempt.rest and time.monotonic() < deadline:
            time.sleep(_POLL_SECONDS)
            self._take(attempt)
        for one in attempt.rest if error is None else ():
            self._fail(attempt, one, events.SettingFailed(f"its worker's messages are missing in {self.spool.parent}"))
        lost: list[Episode] = []
        if isinstance(error, StorageError) or (error is not None and self.is_here):
            raise error
        if isinstance(error, WorkerLost):  # the running episode has failed; the others run again
            self._fail(attempt, attempt.last, events.SettingFailed(str(error)))
            lost = self._lost(attempt)
        elif error is not None:
            for one in attempt.block.episodes:
                self._fail(attempt, one, failure_of(error))
        self._release(attempt)
        if lost:
            self.waiting.append(Block(tuple(lost)))

    def _lost(self, attempt: _Attempt) -> list[Episode]:
        """Return the episodes of a lost worker's block that must run again.

        These are the episodes that have neither ended nor failed. If a setting's results depend on the order of its
        episodes, the ended ones run again, too, and no longer count as done.
        """
        rest = attempt.rest
        whole = {one.setting.work for one in rest if one.setting.depends_on_order}
        again = {one for one in attempt.ended if one.setting.work in whole}
        self.outcome.done[:] = [one for one in self.outcome.done if one not in again]
        return [one for one in attempt.block.episodes if one in again or one in rest]

    def _release(self, attempt: _Attempt) -> None:
        """Give up the reservation of a block's episodes.

        If writing fails, the reservation still ends with this run.
        """
        shutil.rmtree(attempt.spool.folder, ignore_errors=True)
        mine = BLOCKS.c.id == attempt.id
        release = sa.update(BLOCKS).values(claim=None) if attempt.ended else sa.delete(BLOCKS)
        with contextlib.suppress(StorageError), self.database.writing() as connection:
            connection.execute(release.where(mine))
        self.attempts = [other for other in self.attempts if other is not attempt]
