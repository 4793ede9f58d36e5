"""Runs the blocks of a plan through an executor and writes each episode when it ends.

The settings of a block take turns in one process, episode by episode. A worker hands each episode back to the process
that began the run, which alone writes. A kill costs at most the episodes in flight.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import os
import secrets
import shutil
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base import errors
from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.base.files import storage_errors, visible
from kerv_cli.base.leftovers import temporary_beside
from kerv_cli.base.provenance import stamp
from kerv_cli.base.registry import find
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.code import code_hash
from kerv_cli.episodes.identity import ENGINE, depends_on_order
from kerv_cli.episodes.rows import decodes_blob, episode_row, seconds_blob
from kerv_cli.lab.database import BLOCKS, DECODES, EPISODES, RUNNING, now
from kerv_cli.lab.events import (
    BlockEnded,
    BlockStarted,
    BlockWaits,
    EpisodeEnd,
    OnEvent,
    Outcome,
    SettingFailed,
    Started,
)
from kerv_cli.lab.executors import Executor, WorkerLost, check_executor
from kerv_cli.lab.plan import Block, Measured, Setting, Split, Wanted, seeds_text, split
from kerv_cli.lab.runs import Run, is_running, run_rows
from kerv_cli.lab.store import ROLLOUT, StudyStore, stock_of

_POLL_SECONDS = 0.2

RunEpisode = Callable[[int], EpisodeRecord]
"""Runs the episode of a seed."""

Prepare = Callable[[Setting, str], RunEpisode]
"""Builds and warms up a setting on a task. Picklable. For a batch it has a method too, `EpisodeRunner.together`."""


@dataclass(frozen=True)
class Message:
    """What a worker tells of an episode of its block.

    Attributes:
        kind: begun, ended or failed.
        index: Position of the episode in the block.
        row: Columns of the episode, or the reason and trace of a failure.
        blob: Its decodes as Parquet.
    """

    kind: str
    index: int
    row: dict[str, Any] = field(default_factory=dict)
    blob: bytes = b""

    def packed(self) -> bytes:
        """Return the message as bytes."""
        return json.dumps([self.kind, self.index, self.row]).encode() + b"\n" + self.blob

    @staticmethod
    def unpacked(content: bytes) -> Message:
        """Return the message in bytes of `packed`."""
        head, _, blob = content.partition(b"\n")
        kind, index, row = json.loads(head)
        return Message(kind, index, row, blob)


Send = Callable[[Message], None]


@dataclass(frozen=True)
class Spool:
    """Hands messages to another process, as files in a folder that both see. Picklable."""

    folder: Path

    def __call__(self, message: Message) -> None:
        """Write a message. Raises StorageError: the disk refused."""
        path = self.folder / f"{time.time_ns():020d}"
        with storage_errors(path):
            temporary = temporary_beside(path)
            temporary.write_bytes(message.packed())
            os.replace(temporary, path)

    def take(self) -> Iterator[Message]:
        """Yield the messages that are there, the oldest first, and remove each."""
        for path in visible(self.folder):
            content = path.read_bytes()
            path.unlink()
            yield Message.unpacked(content)


@dataclass(frozen=True)
class BlockRun:
    """One attempt to run a block: the function that an executor calls. Picklable with a `Spool`."""

    block: Block
    prepare: Prepare
    send: Send

    def __call__(self) -> None:
        """Run the block, and send each episode as it ends."""
        left_out: set[tuple[str, str]] = set()  # (setting, task) that failed
        steps = self._take_turns() if self.block.batch == 1 else self._together()
        for one, step in steps:
            if (one.setting.work, one.task) in left_out:
                continue
            index = self.block.wanted.index(one)
            try:
                message = step()
            except StorageError:
                raise
            except Exception as error:  # noqa: BLE001 - one setting's failure must not end the others
                left_out.add((one.setting.work, one.task))
                message = Message("failed", index, failure_row(error))
            if message is not None:
                self.send(dataclasses.replace(message, index=index))

    def _take_turns(self) -> Iterator[tuple[Wanted, Callable[[], Message | None]]]:
        """Build every setting, then run the episodes in turn."""
        runners: dict[str, RunEpisode] = {}

        def build(one: Wanted) -> None:
            self.send(Message("begun", self.block.wanted.index(one)))
            runners[one.setting.work] = self.prepare(one.setting, one.task)

        for setting in self.block.settings:
            first = next(one for one in self.block.wanted if one.setting.work == setting.work)
            yield first, functools.partial(build, first)
        for order, one in enumerate(self.block.turns()):
            yield one, lambda one=one, order=order: self._episode(one, order, runners[one.setting.work])  # type: ignore[misc]

    def _episode(self, one: Wanted, order: int, run: RunEpisode) -> Message:
        self.send(Message("begun", self.block.wanted.index(one)))
        device = str(one.setting.settings["runtime"]["device"])
        started = datetime.now(UTC)
        return _ended(run(one.seed), order, started, device)

    def _together(self) -> Iterator[tuple[Wanted, Callable[[], Message | None]]]:
        """Take the episodes of a batch as they end."""
        self.send(Message("begun", 0))
        runner: Any = self.prepare
        device = str(self.block.wanted[0].setting.settings["runtime"]["device"])
        order = itertools.count()

        def take(result: EpisodeRecord | Exception) -> Message:
            if isinstance(result, Exception):
                raise result
            started = datetime.now(UTC) - timedelta(seconds=result.wall_seconds)
            return _ended(result, next(order), started, device)

        try:
            for one, result in runner.together(self.block.wanted):
                yield one, functools.partial(take, result)
        except Exception as error:  # noqa: BLE001 - what the decodes have in common failed
            for index in {one.task: index for index, one in enumerate(self.block.wanted)}.values():
                self.send(Message("failed", index, failure_row(error)))


def _ended(record: EpisodeRecord, order: int, started: datetime, device: str) -> Message:
    row = episode_row(record) | {
        "order": order,
        "started": started.isoformat(timespec="milliseconds"),
        "worker_pid": os.getpid(),
        "decode_seconds": [decode.seconds for decode in record.decodes],
        "about": stamp(device),
    }
    return Message("ended", 0, row, decodes_blob(record))


def failure_row(error: BaseException) -> dict[str, Any]:
    """Return an error as JSON values: one line, the traceback, and the name of its class."""
    trace = "".join(traceback.format_exception(error))
    return {"reason": one_line(error), "trace": trace, "class": type(error).__name__}


def _own_error(row: Mapping[str, Any]) -> KervError | None:
    """Return the error in a `failure_row`, if it is one of kerv's own."""
    kind = getattr(errors, row["class"], None)
    if not isinstance(kind, type) or not issubclass(kind, KervError):
        return None
    return kind.__new__(kind, row["reason"])


def one_line(error: BaseException) -> str:
    """Return an error in one line: the message of a KervError; of any other also its type and place."""
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    line = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text[:200]}{line}"


def execute(
    plan: Split,
    prepare: Prepare,
    store: StudyStore,
    record: Run,
    runtime: RuntimeSettings | None = None,
    on_event: OnEvent = lambda event: None,
) -> Outcome:
    """Run the episodes that a plan lacks, block by block.

    A setting that raises, or whose worker is killed, is reported as failed; the rest of its block goes on. Blocks that
    another sweep computes are waited for. With one local worker everything happens in this process.

    Raises:
        StorageError: The disk refused a result. UsageError: The executor cannot be used.
    """
    return _Sweep(plan, prepare, store, record, runtime or RuntimeSettings(), on_event).run()


class _Sweep:
    """State of one call of `run`."""

    def __init__(
        self,
        plan: Split,
        prepare: Prepare,
        store: StudyStore,
        record: Run,
        runtime: RuntimeSettings,
        on_event: OnEvent,
    ) -> None:
        self.plan, self.prepare, self.store, self.record = plan, prepare, store, record
        self.runtime, self.on_event = runtime, on_event
        self.database = store.database
        self.outcome = Outcome(reused=list(plan.there))
        self.waiting: deque[Block] = deque(plan.blocks(runtime.workers))
        self.elsewhere: list[Block] = []  # another sweep computes them
        self.attempts: dict[Future[None], _Attempt] = {}
        self.spool = self.database.results / "spool" / record.id

    def run(self) -> Outcome:
        clock = time.perf_counter()
        options = check_executor(self.runtime)
        self._clean()
        total = len(self.plan.to_run)
        self.record.beat(0, total, at_once=True)
        self.on_event(Started(total, len(self.plan.there)))
        if self.waiting:
            threads = max(one.setting.settings["runtime"]["threads"] for one in self.plan.to_run)
            part = find("executor", self.runtime.executor)
            executor = part.built(options, self.runtime.workers, threads, self.store.root / "jobs")
            self._run_blocks(executor)
        return dataclasses.replace(self.outcome, seconds=time.perf_counter() - clock)

    def _clean(self) -> None:
        """Remove the messages that workers of killed runs have left."""
        live = {row.id for row in run_rows(self.database) if row.status == RUNNING}
        for folder in visible(self.spool.parent):
            if folder.name not in live:
                shutil.rmtree(folder, ignore_errors=True)

    def _run_blocks(self, executor: Executor) -> None:
        """Keep every slot busy until all blocks are settled."""
        finished = False
        try:
            while self.waiting or self.attempts or self.elsewhere:
                while self.waiting and len(self.attempts) < executor.slots:
                    self._begin(executor, self.waiting.popleft())
                done = wait(self.attempts, timeout=_POLL_SECONDS, return_when=FIRST_COMPLETED).done
                for attempt in self.attempts.values():
                    self._take(attempt)
                for future in done:
                    self._settle(self.attempts.pop(future), future)
                self._beat()
                self._look_elsewhere()
            finished = True
        finally:
            executor.close(abandon=not finished)
            for attempt in self.attempts.values():
                with contextlib.suppress(KervError):  # the first error is to be shown
                    self._take(attempt)
                self._give_up(attempt)
            shutil.rmtree(self.spool, ignore_errors=True)
            with contextlib.suppress(OSError):
                self.spool.parent.rmdir()  # refused while other sweeps use it

    def _begin(self, executor: Executor, block: Block) -> None:
        """Claim a block and hand it to the executor, without what another sweep has run since."""
        name = f"{self.record.id}-{secrets.token_hex(4)}"
        if not self._claim(block, name):
            self.elsewhere.append(block)
            self.on_event(BlockWaits(block))
            return
        attempt = _Attempt(block, name, Spool(self.spool / name))
        rest = self._without_found(attempt)
        if rest is None:
            self._release(attempt)
            return
        attempt.block = rest
        self.on_event(BlockStarted(rest))
        send: Send = attempt.spool
        if executor.slots == 1 and self.runtime.executor == "local":
            send, attempt.is_here = functools.partial(self._note, attempt), True
        else:
            with storage_errors(attempt.spool.folder):
                attempt.spool.folder.mkdir(parents=True, exist_ok=True)
        try:
            future = executor.submit(BlockRun(rest, self.prepare, send))
        except BaseException:  # Ctrl-C while the block ran here
            self._give_up(attempt)
            raise
        self.attempts[future] = attempt

    def _claim(self, block: Block, name: str) -> bool:
        """Insert the row of a block; False if another run at work computes some of it for the same study."""
        episodes = {"/".join(map(str, (self.store.name, *one.key))) for one in block.wanted}
        with self.database.writing() as connection:
            for held in connection.execute(sa.select(BLOCKS).where(BLOCKS.c.claim.is_not(None))).all():
                if episodes.isdisjoint(json.loads(held.claim)):
                    continue
                if held.run != self.record.id and is_running(connection, held.run):
                    return False
                connection.execute(sa.update(BLOCKS).where(BLOCKS.c.id == held.id).values(claim=None))
            connection.execute(
                sa.insert(BLOCKS).values(
                    id=name, run=self.record.id, claim=json.dumps(sorted(episodes)), seeds=seeds_text(block.seeds),
                    started=now(), code=code_hash(), about={},
                )
            )  # fmt: skip
        return True

    def _without_found(self, attempt: _Attempt) -> Block | None:
        """Return the block without the episodes that other sweeps have run since this one was planned."""
        block, study = attempt.block, self.plan.study
        works = {one.setting.work for one in block.wanted}
        stock = {
            key: [row for row in rows if row.id > self.plan.newest]
            for key, rows in stock_of(self.database, works, self.store.kind == ROLLOUT).items()
        }
        found = split(dataclasses.replace(study, wanted=block.wanted), stock).there
        if found:
            self._link(found)
        rest = tuple(one for one in block.wanted if one not in found)
        return Block(rest) if rest else None

    def _link(self, found: Mapping[Wanted, Measured]) -> None:
        with self.database.writing() as connection:
            for one, row in found.items():
                connection.execute(self.store.wants(one).values(episode_id=row.id, error=None))
        for one in found:
            self.outcome.reused.append(one)
            self.on_event(EpisodeEnd(one, elsewhere=True))

    def _take(self, attempt: _Attempt) -> None:
        """Write what a worker has handed back."""
        for message in attempt.spool.take():
            self._note(attempt, message)

    def _note(self, attempt: _Attempt, message: Message) -> None:
        one = attempt.block.wanted[message.index]
        attempt.last = one
        if message.kind == "ended":
            self._write(attempt, one, message)
            attempt.ended.add(one)
            self.outcome.done.append(one)
            self.on_event(EpisodeEnd(one, bool(message.row["success"]), float(message.row["wall_seconds"])))
        elif message.kind == "failed":
            self._fail(attempt, one, message.row)
        self._beat()

    def _write(self, attempt: _Attempt, one: Wanted, message: Message) -> None:
        """Commit an episode, its decodes and the link of what wants it."""
        row = dict(message.row)
        about = row.pop("about")
        row["decode_seconds"] = seconds_blob(row["decode_seconds"])
        work, task, seed, repeat = one.key
        with self.database.writing() as connection:
            if not attempt.ended:
                about |= {"engine": ENGINE, "executor": self.runtime.executor, "workers": self.runtime.workers}
                connection.execute(sa.update(BLOCKS).where(BLOCKS.c.id == attempt.name).values(about=about))
            added = sa.insert(EPISODES).values(
                {"work": work, "task": task, "seed": seed, "repeat": repeat, "block": attempt.name, **row}
            )
            number = connection.execute(added.returning(EPISODES.c.id)).scalar_one()
            connection.execute(sa.insert(DECODES).values(episode_id=number, parquet=message.blob))
            is_wanted = connection.execute(self.store.wants(one).values(episode_id=number, error=None)).rowcount
        if not is_wanted:
            raise KervError(f"study {self.store.name} was deleted while it ran: the same command begins it anew")

    def _fail(self, attempt: _Attempt, one: Wanted, row: Mapping[str, Any]) -> None:
        """Note that a setting failed: its episodes of the block are left out."""
        error = _own_error(row)
        if isinstance(error, StorageError):
            raise error
        same = [
            other for other in attempt.block.wanted if (other.setting.work, other.task) == (one.setting.work, one.task)
        ]
        rest = [other for other in same if other not in attempt.ended and other not in attempt.failed]
        rest.sort(key=lambda other: other is not one)
        if not rest:
            return
        attempt.failed.update(rest)
        with self.database.writing() as connection:
            for other in rest:
                connection.execute(self.store.wants(other).values(error=row["trace"] or row["reason"]))
        end = SettingFailed(tuple(rest), row["reason"], row["trace"], error)
        self.outcome.failed.append(end)
        self.on_event(end)

    def _settle(self, attempt: _Attempt, future: Future[None]) -> None:
        """Take what a block's process has left, and go on with what it lost."""
        self._take(attempt)
        shutil.rmtree(attempt.spool.folder, ignore_errors=True)
        error = future.exception()
        lost = None
        if isinstance(error, StorageError) or (error is not None and attempt.is_here):
            self._give_up(attempt)
            raise error
        if isinstance(error, WorkerLost):  # the episode that ran has failed; the others run again
            self._fail(attempt, attempt.last or attempt.block.wanted[0], failure_row(error) | {"trace": ""})
            lost = self._lost(attempt)
        elif error is not None:
            for one in attempt.block.wanted:
                self._fail(attempt, one, failure_row(error))
        self._release(attempt)
        self.on_event(BlockEnded(attempt.block))
        if lost:
            self.waiting.append(Block(tuple(lost)))

    def _lost(self, attempt: _Attempt) -> list[Wanted]:
        """Return what a block's process did not come to, and all of a setting that depends on the order of episodes."""
        left = [one for one in attempt.block.wanted if one not in attempt.ended and one not in attempt.failed]
        whole = {one.setting.work for one in left if depends_on_order(one.setting.settings)}
        again = {one for one in attempt.ended if one.setting.work in whole}
        self.outcome.done[:] = [one for one in self.outcome.done if one not in again]
        return [one for one in attempt.block.wanted if one in again or one in left]

    def _give_up(self, attempt: _Attempt) -> None:
        """Release a block after an error, which is to be shown: a claim is void anyway once its run has ended."""
        with contextlib.suppress(StorageError):
            self._release(attempt)

    def _release(self, attempt: _Attempt) -> None:
        with self.database.writing() as connection:
            mine = BLOCKS.c.id == attempt.name
            if attempt.ended:
                connection.execute(sa.update(BLOCKS).where(mine).values(claim=None))
            else:
                connection.execute(sa.delete(BLOCKS).where(mine))

    def _beat(self) -> None:
        """Note that this process lives."""
        self.record.beat(len(self.outcome.done))

    def _look_elsewhere(self) -> None:
        """When nothing else is left to do, look again at the blocks that other sweeps compute."""
        if self.elsewhere and not self.waiting and not self.attempts:
            time.sleep(1.0)
            self.waiting.extend(self.elsewhere)
            self.elsewhere = []


@dataclass
class _Attempt:
    """A block that runs. last: the episode that ran last. is_here: it runs in this process."""

    block: Block
    name: str
    spool: Spool
    last: Wanted | None = None
    is_here: bool = False
    ended: set[Wanted] = field(default_factory=set)
    failed: set[Wanted] = field(default_factory=set)
