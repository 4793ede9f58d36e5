"""Workers, and the sweep that follows them until every episode of its plan has ended or failed.

A worker claims a block of episodes, runs it, commits each episode when it ends, and claims the next. Within a block the
settings take turns in one process, episode by episode. A worker that is killed loses at most the episodes that are
running. Another worker runs the rest of its block.
"""

from __future__ import annotations

import os
import secrets
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, EpisodeError, KervError, StorageError
from kerv_cli.base.registry import ArtifactPart
from kerv_cli.base.runtime import set_up
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.identity import ENGINE, OBSERVATION, Setting
from kerv_cli.episodes.policy import artifacts_of, check
from kerv_cli.episodes.rows import decodes_table, episode_row, seconds_blob, table_blob
from kerv_cli.episodes.runner import Runner, close_worlds
from kerv_cli.lab.database import now
from kerv_cli.lab.plan import Block, Episode, seeds_text
from kerv_cli.lab.queue import MOST_DEATHS, Claim, ClaimLost, Queue, patiently
from kerv_cli.lab.runs import Presence, Run, bury
from kerv_cli.lab.store import Study, loaded, rows_of
from kerv_cli.lab.study import Plan, is_elsewhere
from kerv_cli.targets.provenance import stamp

POLL_SECONDS = 1.0
"""Seconds between two queries of the queue while other processes run all blocks that are left."""
FOLLOW_SECONDS = 0.3
"""Seconds between two counts of the episodes that are left."""
WAITING_SECONDS = 10.0
"""Seconds between two lines that say that a worker waits."""

RunEpisode = Callable[[int], EpisodeRecord]
"""Function that runs the episode with a given seed."""

Prepare = Callable[[Setting, str], RunEpisode]
"""Object that, when called, builds and warms up a setting's decoder for a task."""

Save = Callable[[EpisodeRecord, Path, str], object]
"""Function that writes an episode to a .rrd file. The last argument is the setting's label."""


@dataclass(frozen=True)
class BlockStarted:
    """A worker has claimed a block (episodes that one process runs)."""

    block: Block


@dataclass(frozen=True)
class Preparing:
    """A worker builds the decoder of a setting: number `number` of the `of` settings in its block."""

    setting: Setting
    number: int
    of: int


@dataclass(frozen=True)
class BlocksWait:
    """No episode is free to run: other workers run the `episodes` left, or nobody does if `has_workers` is false."""

    episodes: int
    has_workers: bool = True


@dataclass(frozen=True)
class Counted:
    """`left` of a study's episodes have neither ended nor failed, wherever they run."""

    left: int


@dataclass(frozen=True)
class EpisodeEnd:
    """An episode has ended, after `seconds` of wall time."""

    episode: Episode
    success: bool = False
    seconds: float = 0.0


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


Event = BlockStarted | Preparing | BlocksWait | EpisodeEnd | SettingFailed | Counted
OnEvent = Callable[[Event], None]

Tend = Callable[[int], object]
"""Function that looks after the workers. Call it again and again with the number of episodes left."""


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


def follow(plan: Plan, record: Run, tend: Tend, prepare: Prepare, on_event: OnEvent) -> Outcome:
    """Wait until no episode of a saved plan is left. With one worker, this process is the worker.

    Args:
        plan: The plan.
        record: The `Run` of this command.
        tend: Looks after the workers, from `workers`.
        prepare: Builds a setting's decoder for a task. Used in this process only.
        on_event: Called with each event, to show progress.
    """
    began, counted = time.perf_counter(), 0.0
    queue = Queue(plan.study, record.worker, record.id)

    def left() -> int:
        nonlocal counted
        waiting, counted = patiently(queue.left, plan.study), time.monotonic()
        on_event(Counted(waiting))
        record.beat(max(0, len(plan.to_run) - waiting))
        return waiting

    def see(event: Event) -> None:
        on_event(event)
        if isinstance(event, EpisodeEnd) and time.monotonic() - counted > FOLLOW_SECONDS:
            left()

    if plan.runtime.workers == 1 and not is_elsewhere(plan.runtime):
        work(queue, prepare, see, lambda: not left())
    told = time.monotonic()
    while waiting := left():
        tend(waiting)
        if time.monotonic() - told > WAITING_SECONDS:
            told = time.monotonic()
            if not patiently(queue.has_workers):
                on_event(BlocksWait(waiting, has_workers=False))
        time.sleep(FOLLOW_SECONDS)
    return _outcome(plan, time.perf_counter() - began)


def _outcome(plan: Plan, seconds: float) -> Outcome:
    study, outcome = plan.study, Outcome(seconds=seconds)
    with study.database.reading() as connection:
        rows = {(row.label, row.task, row.seed): row for row in rows_of(connection, study.name)}
    if not rows:
        raise KervError(f"study {study.name} was deleted while it ran: run the same command to start it again")
    failed, shown = dict[Any, dict[Episode, None]](), {one.key: one for one in plan.missing}
    for one in study.episodes:
        row = rows.get((one.setting.label, one.task, one.seed))
        if row is None or row.episode_id is None:
            error = (row and row.error) or "another command took it out of the study: run the same command again"
            failed.setdefault((one.setting.work, one.task, error), {})[one] = None
        elif one in plan.existing:
            outcome.reused.append(one)
        elif shown.get(one.key, one) is one:  # an episode that several labels share ran once
            outcome.done.append(one)
    for (_, _, error), episodes in failed.items():
        reason, _, trace = error.partition("\n")
        outcome.failed.append(SettingFailed(reason, trace, episodes=tuple(episodes)))
    return outcome


def work_on(study: Study, run: str, on_event: OnEvent, save: Save) -> None:
    """Run blocks (groups of episodes) of a study until none is left. For `kerv work`.

    Args:
        study: The study.
        run: Id of the command that has started this process. Empty if a user has.
        on_event: Called with each event, to show progress.
        save: Writes the recording (.rrd file) of an episode.
    """
    if not run:  # a sweep of this machine has checked its settings
        study = loaded(study)
        for setting in study.settings:
            set_up(setting.on(study.tasks[0]).runtime)
            checked(setting, study.tasks, str(study.database.results))
    try:
        with Presence(study.database, run) as presence:
            work(Queue(study, presence.worker, run), EpisodeRunner(study.rollouts, save), on_event)
    finally:
        close_worlds()


def checked(setting: Setting, tasks: list[str], results: str, is_awaited: bool = False) -> Setting:
    """Check that the weights and data that a stored setting uses are still the same.

    Return the setting, changed to run in the folder `results`. With `is_awaited`, a server that does not answer is
    tried for two minutes.
    """
    here = replace(setting, settings={**setting.settings, "results": results})
    identity = check(here.on(*tasks), is_awaited)
    for kind in setting.identity.keys() | identity.keys():
        before, after = setting.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and before != after:
            artifacts = artifacts_of(here.on(*tasks))
            path = (
                artifacts.folder if kind == "target" else artifacts.path(kind) if kind in ArtifactPart.every() else ""
            )
            changed = f"has changed from {before[:12]} to {after[:12]} since it was planned"
            raise CheckpointError(f"the {kind} of {setting.label} {changed}: {path}".removesuffix(": "))
    return replace(here, identity=identity)


def work(
    queue: Queue,
    prepare: Prepare,
    on_event: OnEvent = lambda event: None,
    is_done: Callable[[], bool] = lambda: False,
) -> None:
    """Claim and run blocks (groups of episodes), one after another, until none is left.

    If a setting fails, the failure is reported and the other settings go on. If other workers run all blocks that are
    left, this one waits for their end, because it can claim the block of a worker that dies.

    Args:
        queue: The blocks.
        prepare: Builds a setting's decoder for a task.
        on_event: Called with each event, to show progress.
        is_done: Says whether to end before all blocks have ended.
    """
    load, told = load_per_core(), 0.0
    with queue.database.reading():  # a SQLite file that stays open is not flushed after every transaction
        while not is_done():
            claim = patiently(queue.claim)
            if claim is not None:
                _Attempt(queue, claim, prepare, on_event, load).run()
                continue
            left = patiently(queue.left)
            if not left:
                return
            bury(queue.database)
            if time.monotonic() - told > WAITING_SECONDS:
                told = time.monotonic()
                on_event(BlocksWait(left))
            time.sleep(POLL_SECONDS)


def load_per_core() -> float:
    return round(os.getloadavg()[0] / (os.cpu_count() or 1), 2)


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
        order: Number of episodes that have ended.
    """

    queue: Queue
    claim: Claim
    prepare: Prepare
    on_event: OnEvent
    load: float
    started: str = field(default_factory=now)
    left: list[Episode] = field(default_factory=list)
    running: Episode | None = None
    order: int = 0

    def run(self) -> None:
        block = self.claim.block
        self.left = list(block.turns())
        self.id = f"{self.claim.run}-{secrets.token_hex(4)}"
        try:
            if self.claim.deadly is not None:
                self._fail(self.claim.deadly, SettingFailed(f"{MOST_DEATHS} workers died in this episode"))
            if self.left:
                self.on_event(BlockStarted(block))
                self._in_turn()
        except ClaimLost:  # another worker has it, because this one was silent for too long: it did not die
            if self.running is not None:
                patiently(self.queue.survive, self.running)

    def _begin(self, one: Episode) -> None:
        if one is not self.running:
            patiently(self.queue.begin, one, self.running)
            self.running = one

    def _in_turn(self) -> None:
        runners, settings = dict[str, RunEpisode](), self.claim.block.settings
        for number, setting in enumerate(settings, 1):
            first = next((one for one in self.left if one.setting.work == setting.work), None)
            if first is not None:
                self.on_event(Preparing(setting, number, len(settings)))
                self._begin(first)
                try:
                    runners[setting.work] = self.prepare(setting, first.task)
                except Exception as error:  # noqa: BLE001 - the other settings go on
                    self._fail(first, failure_of(error))
        for one in list(self.left):
            if one in self.left:
                self._begin(one)
                started = datetime.now(UTC)
                try:
                    record = runners[one.setting.work](one.seed)
                except Exception as error:  # noqa: BLE001 - the other settings go on
                    self._fail(one, failure_of(error))
                else:
                    self._end(one, record, started)

    def _end(self, one: Episode, record: EpisodeRecord, started: datetime) -> None:
        row = episode_row(record) | {
            "order": self.order,
            "started": started.isoformat(timespec="milliseconds"),
            "decode_seconds": seconds_blob(decode.seconds for decode in record.decodes),
        }
        decodes = table_blob(decodes_table(record))
        is_next = self.running in (one, None)
        then = next((other for other in self.left if other is not one), None) if is_next else None
        patiently(self.queue.write, one, self._row(), row, decodes, then)
        self.running = then if is_next else self.running
        self.left.remove(one)
        self.order += 1
        self.on_event(EpisodeEnd(one, bool(row["success"]), float(row["wall_seconds"])))

    def _row(self) -> dict[str, Any]:
        runtime = self.claim.block.episodes[0].setting.settings["runtime"]
        about = stamp(str(runtime["device"])) | {"engine": ENGINE, "load": self.load, "workers": runtime["workers"]}
        return {"id": self.id, "run": self.claim.run, "seeds": seeds_text(self.claim.block.seeds),
                "started": self.started, "about": about}  # fmt: skip

    def _fail(self, one: Episode, failure: SettingFailed) -> None:
        """Report that a setting failed on a task. Its remaining episodes in the block will not run."""
        if isinstance(failure.error, StorageError | ClaimLost):
            raise failure.error
        same = [other for other in self.left if (other.setting.work, other.task) == (one.setting.work, one.task)]
        if isinstance(failure.error, EpisodeError):  # it concerns no other episode
            same = [other for other in same if other is one]
        if not same:
            return
        same.sort(key=lambda other: other is not one)
        patiently(self.queue.fail, same, f"{failure.reason}\n{failure.trace}")
        self.left = [other for other in self.left if other not in same]
        self.running = None if self.running in same else self.running
        self.on_event(replace(failure, episodes=tuple(same)))


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

    def __call__(self, setting: Setting, task: str) -> RunEpisode:
        def save(record: EpisodeRecord) -> None:
            self.save(record, self.rollouts / Episode(setting, record.task, record.seed).recording, setting.label)

        results = str(setting.settings["results"])
        checked(setting, [task], results, is_awaited=True)
        runner = Runner(setting.on(task), task, save)
        checked(setting, [task], results, is_awaited=True)  # nobody has replaced the weights while they were read
        return runner.episode
