"""A worker: claims a block of episodes, runs it, commits each episode when it ends, and claims the next.

Within a block the settings take turns in one process, episode by episode. A worker that is killed loses at most the
episodes that are running. Another worker runs the rest of its block. If two workers die in the same episode, its
setting fails in this block.
"""

from __future__ import annotations

import functools
import itertools
import os
import secrets
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Any

from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.identity import ENGINE, code_hash
from kerv_cli.episodes.rows import decodes_table, episode_row, seconds_blob, table_blob
from kerv_cli.lab.database import now
from kerv_cli.lab.plan import Episode, Setting, seeds_text
from kerv_cli.lab.progress import (
    BlockStarted,
    BlocksWait,
    EpisodeEnd,
    OnEvent,
    Preparing,
    SettingFailed,
    load_per_core,
)
from kerv_cli.lab.queue import Claim, ClaimLost, Queue, patiently
from kerv_cli.targets.provenance import stamp

POLL_SECONDS = 1.0
"""Seconds between two queries of the queue while other processes run all blocks that are left."""

RunEpisode = Callable[[int], EpisodeRecord]
"""Function that runs the episode with a given seed."""

Prepare = Callable[[Setting, str], RunEpisode]
"""Function that builds and warms up a setting's decoder for a task. Its method `together` runs batches."""


def work(queue: Queue, prepare: Prepare, on_event: OnEvent = lambda event: None) -> None:
    """Claim and run the blocks (groups of episodes) of a queue, one after another, until none is left.

    If a setting fails, it is reported and the other settings go on. While other workers run all blocks that are left,
    wait: if one of them dies, its block is free again.

    Args:
        queue: The blocks.
        prepare: Builds a setting's decoder for a task.
        on_event: Called with each event, to show progress.

    Raises:
        StorageError: The disk is full or not writable, or the database did not answer for two minutes.
        KervError: The blocks were planned by another version of kerv.
    """
    load, is_waiting, ended = load_per_core(), False, None
    code_hash()  # takes a second when it is called first, in which this worker should hold no block
    with queue.beating():
        while True:
            claim = patiently(functools.partial(queue.claim, ended))
            ended = None
            if claim is not None:
                is_waiting = False
                if _Attempt(queue, claim, prepare, on_event, load).run():
                    ended = claim
            elif not patiently(queue.left)[0]:
                return
            else:
                if not is_waiting:
                    on_event(BlocksWait())
                is_waiting = True
                _wait(queue)


def _wait(queue: Queue) -> None:
    """Wait until some block is free, or none is left."""
    while True:
        time.sleep(POLL_SECONDS)
        left, free = patiently(queue.left)
        if free or not left:
            return


def failure_of(error: BaseException) -> SettingFailed:
    """Describe an error in one line. For errors that are not KervErrors, add the type, file and line."""
    trace = "".join(traceback.format_exception(error))
    text = " ".join(str(error).split())
    if isinstance(error, KervError):
        return SettingFailed(text, trace, error)
    frames = traceback.extract_tb(error.__traceback__)
    line = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return SettingFailed(f"{type(error).__name__}: {text[:200]}{line}", trace)


@dataclass(eq=False)
class _Attempt:
    """A block that this process runs.

    Attributes:
        queue: Where it comes from.
        claim: The block.
        prepare: Builds a setting's decoder for a task.
        on_event: Called with each event.
        load: Load average per core when the worker began.
        started: When it began (ISO 8601).
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
        """Run the block. Episodes that others have run meanwhile are linked to the study instead.

        Returns:
            Whether it has ended. If not, the claim was lost.
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
                runner = self._try(first, functools.partial(self.prepare, setting, first.task))
                if runner is not None:
                    runners[setting.work] = runner
        for order, one in enumerate(list(self.left)):
            if one in self.left:
                started = datetime.now(UTC)
                record = self._try(one, functools.partial(runners[one.setting.work], one.seed))
                if record is not None:
                    self._end(one, record, order, started)

    def _try(self, one: Episode, function: Callable[[], Any]) -> Any:
        """Call a function for episode `one`. If it raises, its setting has failed: return None."""
        self._begin(one)
        try:
            return function()
        except Exception as error:  # noqa: BLE001 - the other settings go on
            self._fail(one, failure_of(error))
        return None

    def _begin(self, one: Episode) -> None:
        """Note that an episode, or the preparation of its setting, begins."""
        if one is not self.running:
            patiently(functools.partial(self.queue.begin, self.claim, one))
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
        except KervError as error:
            if isinstance(error, ClaimLost | StorageError):
                raise
            self._fail_all(error)
        except Exception as error:  # noqa: BLE001 - the other blocks go on
            self._fail_all(error)

    def _fail_all(self, error: Exception) -> None:
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
        patiently(functools.partial(self._write, one, row, decodes))
        self.left.remove(one)
        self.on_event(EpisodeEnd(one, bool(row["success"]), float(row["wall_seconds"])))

    def _write(self, one: Episode, row: dict[str, Any], decodes: bytes) -> None:
        """Write an episode and its decodes, link the episode to the study, and begin the next, in one transaction."""
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
                "started": self.started, "code": code_hash(), "about": about}  # fmt: skip

    def _fail(self, one: Episode, failure: SettingFailed) -> None:
        """Note that a setting failed on a task. Its remaining episodes in the block will not run.

        Raises:
            StorageError: This was the failure. Then no other setting can be stored either.
            ClaimLost: The block does not belong to this worker any more.
        """
        if isinstance(failure.error, StorageError | ClaimLost):
            raise failure.error
        same = [other for other in self.left if (other.setting.work, other.task) == (one.setting.work, one.task)]
        if not same:
            return
        same.sort(key=lambda other: other is not one)
        self.failed += same
        patiently(functools.partial(self._write_failure, same, failure))
        self.left = [other for other in self.left if other not in same]
        failure = replace(failure, episodes=tuple(same))
        self.on_event(failure)

    def _write_failure(self, failed: list[Episode], failure: SettingFailed) -> None:
        rest = [one.key for one in self.claim.block.episodes if one not in self.failed]
        with self.queue.database.writing() as connection:
            self.queue.hold(connection, self.claim, episodes=rest)
            for one in failed:
                self.queue.study.update(connection, one, error=f"{failure.reason}\n{failure.trace}")
