"""Plans a study and runs it: `plan` finds the missing episodes, `run` runs them."""

from __future__ import annotations

import contextlib
import re
import secrets
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from kerv_cli.base.errors import CheckpointError, Interrupted, KervError, StorageError, UsageError
from kerv_cli.base.paths import check_writable
from kerv_cli.base.runtime import set_up
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.identity import OBSERVATION, without
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.resolve import ResolvedStudy
from kerv_cli.episodes.runner import Request, Runner, close_worlds, is_recorded, run_batch
from kerv_cli.episodes.settings import settings_from
from kerv_cli.lab.database import Database
from kerv_cli.lab.plan import ALL, Episode, Setting, all_episodes
from kerv_cli.lab.progress import Event, OnEvent, Outcome, Progress, SettingFailed
from kerv_cli.lab.queue import Queue, enqueue
from kerv_cli.lab.runs import Run, interrupted
from kerv_cli.lab.store import ABOUT, ROLLOUT, SWEEP, Study
from kerv_cli.lab.work import Prepare, work
from kerv_cli.lab.workers import Array, LocalWorkers, follow, gpus_in_turn

SLURM = "slurm"
Save = Callable[[EpisodeRecord, Path, str], object]
"""Function that writes an episode to a .rrd file. The last argument is the setting's label."""


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
        runner = Runner(settings_from(setting.on(task)), task)

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
        settings = settings_from(setting.on(episodes[0].task))
        requests = [Request(one, one.task, one.seed) for one in episodes]
        for request, result in run_batch(settings, requests):
            yield request.key, result


def study_of(resolved: ResolvedStudy, database: Database, kind: str = SWEEP) -> Study:
    """Check a study's settings, and return the study with all its episodes. `auto` devices are replaced by real ones.

    Args:
        resolved: The study with all its settings.
        database: The database that has or gets the study's results.
        kind: SWEEP or ROLLOUT.

    Raises:
        UsageError: A setting cannot run, or there are too many episodes.
        CheckpointError: A setting's weights or data cannot be read.
    """
    about, settings = resolved.study, []
    for label, one in resolved.settings.items():
        point, identity = resolved.points[label], check(one)
        one.runtime.device = _device_of(one.runtime)
        plain = without(asdict(one), {"task"})
        settings.append(Setting(label, " ".join(point.overrides), plain, identity, point.varies, point.name))
    settings.sort(key=lambda setting: setting.label != about.baseline)
    episodes = all_episodes(settings, resolved.tasks, about.block, about.repeats)
    own = {name: getattr(about, name) for name in ABOUT}
    return Study(database, about.name, kind, tuple(settings), episodes, **own)


def _device_of(runtime: RuntimeSettings) -> str:
    """Return the device on which episodes run. On a cluster it is that of the nodes: this machine may have no GPU."""
    if runtime.executor != SLURM:
        return set_up(runtime)[0]
    on_node = "cuda" if runtime.executor_options.gpus else "cpu"
    return on_node if runtime.device == "auto" else runtime.device


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
    stored = {**setting.settings, "results": results}
    identity = check(settings_from({**stored, "task": tasks}))
    for kind in setting.identity.keys() | identity.keys():
        before, now = setting.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and before != now:
            raise CheckpointError(
                f"the {kind} of {setting.label} has changed from {before[:12]} to {now[:12]}: it cannot run again"
            )
    return replace(setting, settings=stored, identity=identity)


def plan(resolved: ResolvedStudy, database: Database, command: Sequence[str], kind: str = SWEEP) -> Study:
    """Find out which episodes of a sweep or a rollout are in the database, and which must run.

    A rollout is a new one each time. But if the same command was interrupted before, the rest of its newest rollout is
    planned instead.

    Args:
        resolved: The study with all its settings.
        database: The database.
        command: Command-line arguments (without `kerv`) that resume the sweep or rollout.
        kind: SWEEP or ROLLOUT.

    Raises:
        UsageError: A setting cannot run.
        CheckpointError: A setting's weights or data cannot be read.
        StorageError: The results folder is not writable.
    """
    runtime, rerun = resolved.first.runtime, resolved.sweep.rerun
    if kind == SWEEP and runtime.detach and runtime.executor != SLURM:
        raise UsageError("runtime.detach=true is for clusters: add runtime.executor=slurm")
    check_writable(str(database.results))
    study = study_of(resolved, database, kind)
    if kind == ROLLOUT:
        rerun, runtime = ALL, replace(runtime, workers=1, executor="local")
    known = None if kind == ROLLOUT else study.name  # a new rollout has no name yet
    begun = interrupted(database, kind, command, known) if rerun == ALL else None
    if kind == ROLLOUT:
        done, total = replace(study, name=begun.name).counts() if begun else (0, 0)
        begun = begun if 0 < done < total else None
        study = replace(study, name=begun.name if begun else new_name(study))
    return study.plan(rerun, begun.started if begun else "", runtime, command)


def new_name(study: Study) -> str:
    """Return a name for a new rollout, with date, time and methods: `20260301-142530-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(setting.settings["method"]) for setting in study.settings))
    name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:32]}"
    return f"{name}-{secrets.token_hex(2)}" if replace(study, name=name).exists else name


def run(study: Study, on_event: OnEvent = lambda event: None, *, save: Save = lambda *_: None) -> Outcome:
    """Run the missing episodes of a plan. Each is saved in the database as soon as it ends.

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
        with Run(study.database, study.kind, study.name, study.command, alone=is_rollout) as record:
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
    """The workers of a cluster go on without this command. The message says which."""


def run_blocks(study: Study, prepare: Prepare, record: Run, on_event: OnEvent) -> Outcome:
    """Queue the blocks (groups of episodes) of a plan. Run them in this process, in worker processes or on a cluster.

    When this function returns or raises, no process of this machine runs the plan's blocks any more. No block stays
    queued, unless the workers of a cluster go on without this command. They also go on if this process is killed.

    Args:
        study: The study with its plan.
        prepare: Builds a setting's decoder for a task. Used in this process only.
        record: The database row of this command.
        on_event: Called with each event, to show progress.
    """
    runtime, blocks = study.runtime, study.blocks
    queue, progress = Queue(study, record.id), Progress(study, record, on_event)
    enqueue(study, record.id)
    threads = max((one.setting.settings["runtime"]["threads"] for one in study.to_run), default=1)
    try:
        if blocks and runtime.executor == SLURM:
            _follow_cluster(Array(queue, runtime, threads), progress)
        elif blocks and runtime.workers > 1:
            number = min(runtime.workers, len(blocks))
            with LocalWorkers(queue, number, threads, gpus_in_turn(study.device)) as workers:
                follow(queue, progress, workers.tend)
        elif blocks:
            work(queue, prepare, progress.see)
        outcome = progress.end()
    except BaseException as error:
        if not isinstance(error, Detached):
            with contextlib.suppress(StorageError):
                queue.withdraw()
        raise
    return outcome


def _follow_cluster(array: Array, progress: Progress) -> None:
    """Follow the workers of a cluster until they have run all blocks. If that is interrupted, cancel them.

    Raises:
        Detached: The command was asked not to follow them.
    """
    if array.runtime.detach:
        raise Detached(f"job {array.id} of Slurm runs them, its logs are in {array.logs}")
    try:
        follow(array.queue, progress, lambda: array.tend(progress))
    except KeyboardInterrupt:
        with contextlib.suppress(KervError):
            array.cancel()
        raise


def work_on(study: Study, run_id: str, on_event: OnEvent, save: Save) -> None:
    """Run blocks (groups of episodes) that a sweep of the study has queued, until none is left. For `kerv work`.

    Args:
        study: The study.
        run_id: Only blocks of the command with this id. Empty: all.
        on_event: Called with each event, to show progress.
        save: Writes the recording (.rrd file) of an episode.

    Raises:
        UsageError: The study is not in the database, or its device is not on this machine.
        CheckpointError: Weights or data in this results folder are not those with which the study was planned.
        StorageError: The disk is full or not writable, or the database does not answer.
    """
    if not run_id:  # a sweep of this machine has checked its settings
        study = study.load()
        for setting in study.settings:
            set_up(settings_from(setting.on(study.tasks[0])).runtime)
            checked(setting, study.tasks, str(study.database.results))
    try:
        work(Queue(study, run_id), EpisodeRunner(study.rollouts, save), on_event)
    finally:
        close_worlds()


def _kept(study: Study) -> str:
    """Return how many episodes of a study are stored, as text. If the database does not answer: `all complete …`."""
    try:
        return "{} of {} episodes".format(*study.counts())
    except StorageError:
        return "all complete episodes"
