"""The two calls behind every command that runs episodes: `plan`, which computes nothing, and `run`."""

from __future__ import annotations

import dataclasses
import functools
import re
import secrets
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from kerv_cli.base.errors import Interrupted, KervError
from kerv_cli.base.places import check_writable
from kerv_cli.base.runtime import set_up
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.resolve import ResolvedStudy
from kerv_cli.episodes.runner import Runner, close_worlds, is_recorded, run_batch
from kerv_cli.episodes.settings import settings_from
from kerv_cli.episodes.together import Request
from kerv_cli.lab.database import COMPLETE, Database
from kerv_cli.lab.events import Event, OnEvent, Outcome, SettingFailed
from kerv_cli.lab.execute import execute
from kerv_cli.lab.executors import check_executor
from kerv_cli.lab.plan import ALL, NEVER, Block, Setting, Split, Study, Wanted, plain_settings, wanted_of
from kerv_cli.lab.runs import Run, interrupted_since, run_rows
from kerv_cli.lab.store import ROLLOUT, SWEEP, StudyStore, split_of, studies

_MOST_NAME = 32  # letters of the methods in a rollout's name

Judge = Callable[[StudyStore, Sequence[Wanted], Sequence[str], int, int], list[str]]
"""Told the store, the episodes so far, the labels that are open, the look and the number of looks -> the labels that
stay open."""


OnEpisodeStep = Callable[[Setting, str, int, int], None]
"""Told the setting, the task, the seed and the number of control steps executed, after each of them."""

Save = Callable[[EpisodeRecord, Path, str], object]
"""Writes a recording: the record of the episode, the .rrd file and the label of the setting."""


@dataclass(frozen=True)
class EpisodeRunner:
    """Prepares settings for their episodes. Picklable without `on_step`.

    Attributes:
        rollouts: Folder of the .rrd files, one per recorded episode.
        save: Writes one of them.
        on_step: Shows progress within an episode.
    """

    rollouts: Path
    save: Save
    on_step: OnEpisodeStep | None = None

    def __call__(self, setting: Setting, task: str) -> Callable[[int], EpisodeRecord]:
        """Build the setting's decoder -> the function that runs the episode of a seed."""
        runner = Runner(settings_from(setting.on(task)), task)

        def episode(seed: int) -> EpisodeRecord:
            on_step = functools.partial(self.on_step, setting, task, seed) if self.on_step is not None else None
            record = runner.episode(seed, is_recorded(runner.settings, seed), on_step)
            if record.frames:
                label = setting.label.replace(" ", "_").replace("=", "")
                path = self.rollouts / f"{label}-{record.task}-{seed}-{setting.work[:6]}.rrd"
                self.save(record, path, setting.label)
            return dataclasses.replace(record, frames={}, places={})

        return episode

    def together(self, wanted: Sequence[Wanted]) -> Iterator[tuple[Wanted, EpisodeRecord | Exception]]:
        """Run episodes of one setting, `rollout.batch` at a time; yield each as it ends: its record, or the error that
        its world raised."""
        setting = wanted[0].setting
        settings = settings_from(setting.on(wanted[0].task))
        requests = [Request(one, one.task, one.seed) for one in wanted]
        for request, result in run_batch(settings, requests):
            if self.on_step is not None:
                self.on_step(setting, request.task, request.seed, settings.world.horizon)
            yield request.key, result


def study_of(resolved: ResolvedStudy, kind: str = "sweep") -> Study:
    """Return what a study wants, on the devices of this machine.

    Raises:
        UsageError, CheckpointError: As `check` of each setting. UsageError: Too many episodes.
    """
    about = resolved.study
    identities = {label: check(one) for label, one in resolved.settings.items()}
    for one in resolved.settings.values():
        one.runtime.device, _ = set_up(one.runtime)
    settings = [
        Setting(
            label,
            resolved.overrides[label],
            plain_settings(dataclasses.asdict(one)),
            identities[label],
            resolved.varies.get(label, {}),
            resolved.names.get(label, ""),
        )
        for label, one in resolved.settings.items()
    ]
    settings.sort(key=lambda setting: setting.label != about.baseline)
    wanted = wanted_of(settings, resolved.tasks, about.block, about.repeats)
    return Study(
        about.name, tuple(settings), wanted, kind, about.title, about.baseline, about.axis, about.note, about.block
    )


@dataclass
class Plan(Split):
    """A study split into what is there and what is to run, and where and how it runs.

    Attributes:
        store: The study in the database.
        runtime: Executor, workers, device.
        command: Words after `kerv` that go on with it.
    """

    store: StudyStore = field(kw_only=True)
    runtime: RuntimeSettings = field(kw_only=True)
    command: tuple[str, ...] = field(kw_only=True)


def plan(resolved: ResolvedStudy, command: Sequence[str]) -> Plan:
    """Plan a sweep: the episodes of a study that the database lacks.

    Raises:
        UsageError, CheckpointError: A setting that cannot run. StorageError: The results folder cannot be written.
    """
    first = resolved.first
    check_executor(first.runtime)
    check_writable(first.results)
    study, database = study_of(resolved), Database(first.results)
    since = interrupted_since(database, SWEEP, study.name, command) if resolved.sweep.rerun == ALL else ""
    return plan_study(database, study, first.runtime, command, resolved.sweep.rerun, since)


def plan_rollout(resolved: ResolvedStudy, command: Sequence[str]) -> Plan:
    """Plan a rollout: a new one, or the rest of the newest that the same command left unfinished.

    A complete rollout is not reused, because who types a rollout wants it run. Raises as `plan`.
    """
    first = resolved.first
    check_writable(first.results)
    study, database = study_of(resolved, ROLLOUT), Database(first.results)
    runtime = dataclasses.replace(first.runtime, workers=1, executor="local")
    for row in run_rows(database, ROLLOUT):
        if row.command == tuple(command) and row.status != COMPLETE:
            made = plan_study(database, dataclasses.replace(study, name=row.name), runtime, command, ALL, row.started)
            if made.store.is_there and made.there and made.reasons:
                return made
    return plan_study(database, dataclasses.replace(study, name=new_name(database, study)), runtime, command, ALL)


def plan_again(database: Database, study: Study, name: str, command: Sequence[str]) -> Plan:
    """Plan to measure a stored study again under another name: the one that an interrupted repetition has, else `name`,
    `name2`, ….
    """
    words = tuple(command)
    row = next((row for row in run_rows(database, study.kind) if row.command == words and row.status != COMPLETE), None)
    taken = {store.name for store in studies(database)}
    free = next(one for one in (name, *(f"{name}{number}" for number in range(2, 10_000))) if one not in taken)
    study = dataclasses.replace(study, name=row.name if row else free)
    return plan_study(database, study, RuntimeSettings(), command, ALL, row.started if row else "")


def plan_study(
    database: Database,
    study: Study,
    runtime: RuntimeSettings,
    command: Sequence[str],
    rerun: str = NEVER,
    since: str = "",
) -> Plan:
    """Plan a study whose settings are resolved; see `plan.split`."""
    made = split_of(database, study, rerun, since)
    store = StudyStore(database, study.name, study.kind)
    return Plan(study, made.there, made.reasons, made.newest, store=store, runtime=runtime, command=tuple(command))


def new_name(database: Database, study: Study) -> str:
    """Return a rollout's name by date, time and methods: `20260301-142530-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(setting.settings["method"]) for setting in study.settings))
    name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:_MOST_NAME]}"
    return f"{name}-{secrets.token_hex(2)}" if StudyStore(database, name, ROLLOUT).is_there else name


def run(
    planned: Plan,
    on_event: OnEvent = lambda event: None,
    *,
    save: Save | None = None,
    on_step: OnEpisodeStep | None = None,
    judge: Judge | None = None,
) -> Outcome:
    """Run what a plan lacks. Each episode is in the database as soon as it ends.

    Args:
        planned: What to run.
        on_event: Shows progress.
        save: Writes recordings; None: nothing is recorded.
        on_step: Shows progress within an episode, with one local worker.
        judge: Decides after each block of seeds which settings go on; None: all do.

    Raises:
        Interrupted: Ctrl-C. KervError: An episode of a rollout failed. StorageError: The disk refused.
    """
    store, single = planned.store, planned.runtime.executor == "local" and planned.runtime.workers == 1
    rollout = planned.study.kind == ROLLOUT

    def heard(event: Event) -> None:
        if isinstance(event, SettingFailed) and rollout:
            raise event.error or KervError(event.reason)
        on_event(event)

    runner = EpisodeRunner(store.rollouts, save or _unsaved, on_step if single else None)
    with Run(store.database, planned.study.kind, store.name, planned.command, alone=rollout) as record:
        try:
            if judge is None:
                store.save(planned)
                return execute(planned, runner, store, record, planned.runtime, heard)
            return _until_decided(planned, runner, record, heard, judge)
        except KeyboardInterrupt:
            there, wanted = store.counts()
            raise Interrupted(
                f"interrupted: {there} of {wanted} episodes of {store.name} are kept, the same command goes on there"
            ) from None
        finally:
            close_worlds()


def _unsaved(*args: object) -> None:
    """Write no recording."""


def _until_decided(planned: Plan, runner: EpisodeRunner, record: Run, on_event: OnEvent, judge: Judge) -> Outcome:
    """Run block after block of seeds, and leave out the settings that are decided. The study wants what ran."""
    study, store, total = planned.study, planned.store, Outcome()
    open_labels = [setting.label for setting in study.settings if setting.label != study.baseline]
    looks = looks_of(study)
    so_far: list[Wanted] = []
    for look, wanted in enumerate(looks, 1):
        part = [one for one in wanted if one.setting.label in (study.baseline, *open_labels)]
        so_far += part
        settings = tuple({one.setting.label: one.setting for one in so_far}.values())
        chosen = set(part)
        now = Split(
            dataclasses.replace(study, settings=settings, wanted=tuple(part)),
            {one: row for one, row in planned.there.items() if one in chosen},
            {one: why for one, why in planned.reasons.items() if one in chosen},
            planned.newest,
        )
        store.save(now, whole=look == 1)
        outcome = execute(now, runner, store, record, planned.runtime, on_event)
        total = Outcome(
            total.done + outcome.done,
            total.reused + outcome.reused,
            total.failed + outcome.failed,
            total.seconds + outcome.seconds,
        )
        if outcome.failed:
            return total
        open_labels = judge(store, so_far, open_labels, look, len(looks))
        if not open_labels:
            break
    return total


def looks_of(study: Study) -> list[list[Wanted]]:
    """Return a study's episodes by block of seeds: one look each."""
    first = min(one.seed for one in study.wanted)
    looks: dict[int, list[Wanted]] = {}
    for one in study.wanted:
        looks.setdefault((one.seed - first) // study.block, []).append(one)
    return [looks[number] for number in sorted(looks)]


@dataclass(frozen=True)
class TimeEstimate:
    """Time for the episodes that a plan lacks. source: of the figure, in words."""

    seconds: float
    source: str


def estimate(planned: Plan, prior_seconds: float) -> TimeEstimate:
    """Estimate wall time from the mean wall seconds per episode of the plan's other episodes.

    A setting with such episodes uses its own mean, others the mean over all; `prior_seconds` per episode is the guess
    without any. Workers are taken to scale perfectly, up to one per block.
    """
    means, count = store_means(planned)
    prior = sum(means.values()) / len(means) if means else prior_seconds
    total = sum(means.get(one.setting.work, prior) for one in planned.to_run)
    source = f"measured on {count} stored episodes" if count else f"a guess of {prior_seconds:g} s per episode"
    blocks: list[Block] = planned.blocks(planned.runtime.workers)
    return TimeEstimate(total / max(1, min(planned.runtime.workers, len(blocks))), source)


def store_means(planned: Plan) -> tuple[dict[str, float], int]:
    """Return the mean wall seconds of stored episodes by setting, and how many there are."""
    import sqlalchemy as sa

    from kerv_cli.lab.database import EPISODES

    settings: list[Setting] = list(planned.study.settings)
    columns = EPISODES.c.work, sa.func.avg(EPISODES.c.wall_seconds), sa.func.count()
    query = sa.select(*columns).where(EPISODES.c.work.in_([s.work for s in settings])).group_by(EPISODES.c.work)
    with planned.store.database.reading() as connection:
        rows = connection.execute(query).all()
    return {work: float(mean) for work, mean, _ in rows if mean is not None}, sum(row[2] for row in rows)
