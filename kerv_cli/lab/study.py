"""Plan a study and save its plan: which episodes are in the database, which must run, and in which blocks."""

from __future__ import annotations

import functools
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.config import groups
from kerv_cli.base.errors import UsageError
from kerv_cli.base.paths import check_writable
from kerv_cli.base.runtime import device_of
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.episodes import policy
from kerv_cli.episodes.identity import Setting
from kerv_cli.episodes.resolve import ResolvedStudy, located
from kerv_cli.lab.database import EPISODES, PLANNED, RUNS, SETTINGS, STUDIES, UNFINISHED, WANTED, Database, now
from kerv_cli.lab.plan import ALL, NEVER, Block, Episode, all_episodes, blocks_of, ordered_parts, split
from kerv_cli.lab.runs import interrupted, living
from kerv_cli.lab.store import ABOUT, SWEEP, Study, counts_of, rows_of, setting_of, stored_episodes, swept_by


@dataclass(frozen=True, eq=False)
class Plan:
    """What a command will do for a study.

    Attributes:
        study: The study.
        existing: Row numbers of the episodes that the database has.
        missing: Episodes to run, each with the reason in a few words, such as `new seeds`.
        anew: Whether to run all episodes again.
        runtime: Workers and device.
        command: Command-line arguments (without `kerv`) that resume the study.
    """

    study: Study
    existing: Mapping[Episode, int]
    missing: Mapping[Episode, str]
    anew: bool = False
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    command: tuple[str, ...] = ()

    @functools.cached_property
    def to_run(self) -> list[Episode]:
        """The episodes to run. An episode that several labels share runs once."""
        return list({one.key: one for one in self.missing}.values())

    @functools.cached_property
    def blocks(self) -> list[Block]:
        """The episodes to run, grouped into blocks. One process runs a block. Blocks are ordered by first episode."""
        return blocks_of(self.to_run, self.study.block)


def is_elsewhere(runtime: RuntimeSettings) -> bool:
    return bool(runtime.launch) or not runtime.workers


def check(resolved: ResolvedStudy) -> tuple[Setting, ...]:
    """Check that a study's settings can run. Return them with the hashes of weights and data, the baseline first."""
    check_writable(str(resolved.first.results))
    settings = []
    for label, one in resolved.settings.items():
        point, device = resolved.points[label], one.runtime.device
        if is_elsewhere(resolved.first.runtime):  # this machine may have no GPU
            if device == "auto":
                raise UsageError("runtime.device=auto: workers run elsewhere, name their device: cpu or cuda")
            one.runtime.device = "cpu"
        identity = policy.check(one)
        one.runtime.device = device if is_elsewhere(resolved.first.runtime) else device_of(one.runtime)
        plain = asdict(one)
        del plain["task"]
        settings.append(Setting(label, point.words, plain, identity, point.varies, point.name))
    return tuple(sorted(settings, key=lambda setting: setting.label != resolved.study.baseline))


def plan(
    resolved: ResolvedStudy, settings: Sequence[Setting], database: Database, command: Sequence[str], kind: str = SWEEP
) -> Plan:
    """Find out which episodes of a sweep or a rollout are in the database, and which must run.

    For a rollout, each call plans a new one. If the same command was interrupted before, the rest of its newest rollout
    is planned instead.

    Args:
        resolved: The study with all its settings.
        settings: The checked settings, from `check`.
        database: The database.
        command: Command-line arguments (without `kerv`) that resume the sweep or rollout.
        kind: SWEEP or ROLLOUT.
    """
    about, runtime, rerun, command = resolved.study, resolved.first.runtime, resolved.sweep.rerun, located(command)
    episodes = all_episodes(settings, resolved.tasks, about.block)
    own = {name: getattr(about, name) for name in ABOUT}
    study = Study(database, about.name, kind, tuple(settings), episodes, **own)
    if kind == SWEEP:
        _check_source(study, command)
    else:
        begun = interrupted(database, kind, command)
        done, total = counts_of(replace(study, name=begun)) if begun else (0, 0)
        is_resumed = 0 < done < total
        study = replace(study, name=begun if is_resumed else new_name(study))
        rerun, runtime = NEVER if is_resumed else ALL, replace(runtime, workers=1, launch="")
    return plan_study(study, rerun, runtime, command)


def _check_source(study: Study, command: Sequence[str]) -> None:
    """Refuse a sweep if a stored study of this name comes from another study file that still exists."""
    ours, theirs = (
        next((word.partition("=")[2] for word in words if word.startswith("study=")), "")
        for words in (command, swept_by(study))
    )
    is_there = Path(theirs).is_file() if "/" in theirs else theirs in groups()["study"]
    if is_there and theirs != ours:
        raise UsageError(
            f"study={ours} would replace study '{study.name}' of {theirs} in {study.database.shown}: "
            "choose another study.name=NAME"
        )


def new_name(study: Study) -> str:
    """Return a name for a new rollout, with date, time and methods: `20260301-142530-048151-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(setting.settings["method"]) for setting in study.settings))
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S-%f}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:32]}"


def plan_study(
    study: Study, rerun: str = NEVER, runtime: RuntimeSettings | None = None, command: Sequence[str] = ()
) -> Plan:
    """Compare a study's episodes with the database.

    Args:
        study: The study.
        rerun: Which existing episodes to run again: NEVER or ALL.
        runtime: Workers and device.
        command: Command-line arguments (without `kerv`) that resume the study.
    """
    with study.database.reading() as connection:
        known: dict[Episode, Any] = {}
        of_label = {setting.label: setting for setting in study.settings}
        for row in rows_of(connection, study.name):
            setting = of_label.get(row.label)
            if setting is not None and setting.work == row.work:
                known[Episode(setting, row.task, row.seed)] = row
        stored = stored_episodes(connection, study)
        ran = sa.select(WANTED.c.setting_id).where(WANTED.c.episode_id.is_not(None))
        of_labels = sa.select(SETTINGS).where(SETTINGS.c.label.in_(study.labels), SETTINGS.c.id.in_(ran))
        earlier = {row.label: setting_of(row) for row in connection.execute(of_labels.order_by(SETTINGS.c.id))}
    existing, missing = split(study.episodes, study.block, stored, known, rerun, earlier)
    return Plan(study, existing, missing, rerun == ALL, runtime or RuntimeSettings(), tuple(command))


def save(plan: Plan, run: str = "") -> None:
    """Write a plan in one transaction: the study, its settings, a row per episode, and the blocks to run.

    If no other process runs the study, rows outside the plan are removed. Only rows of other tasks stay, so that sweeps
    over different tasks give one report. They stay if their setting, the baseline and their seed are in the plan, but
    they are no longer run. If another process runs the study, no row is removed, and new rows get blocks of their own.
    A row whose episode ended after planning keeps the episode.

    Args:
        plan: The plan.
        run: Id of this command.
    """
    study = plan.study
    with study.database.writing() as connection:
        alive = living(study.database, connection)
        mine = WANTED.join(STUDIES, WANTED.c.study_id == STUDIES.c.id)
        claimed = sa.select(WANTED.c.worker).select_from(mine)
        claimed = claimed.where(STUDIES.c.name == study.name, UNFINISHED, WANTED.c.worker.in_(alive))
        others = sa.or_(_other_commands(study, alive, run), claimed.exists())
        is_shared = bool(connection.scalar(sa.select(others)))
        flagged = sa.select(SETTINGS.c.label, SETTINGS.c.work, WANTED.c.task, WANTED.c.seed).select_from(PLANNED)
        flagged = flagged.where(STUDIES.c.name == study.name, WANTED.c.anew)
        anew = set(map(tuple, connection.execute(flagged)))  # before `_save_settings`, which can delete the rows
        number, ids = _save_settings(connection, study, is_shared)
        before = {_key(row): _values(row) for row in rows_of(connection, study.name)}
        wanted = {(ids[one.setting.label], one.task, one.seed): one for one in study.episodes}
        after = {key: row for key, row in before.items() if key not in wanted}
        if not is_shared:
            after = _still_asked_for(after, wanted)
        first = max((row["position"] for row in after.values()), default=0) + 1
        works = {setting.work for setting in study.settings}
        stored = set(connection.scalars(sa.select(EPISODES.c.id).where(EPISODES.c.work.in_(works))))
        to_run = dict[Episode, dict[str, Any]]()
        for position, (key, one) in enumerate(wanted.items(), first):
            row, linked = before.get(key), plan.existing.get(one)
            # an episode that ended after planning counts, too
            counts = linked is not None or not (plan.anew or one.setting.depends_on_order)
            if row is not None and (counts if row["episode_id"] is not None else is_shared and _is_unfinished(row)):
                after[key] = row | {"position": position}
                continue
            after[key] = dict(zip(_KEY, key, strict=True)) | {
                "study_id": number, "position": position, "episode_id": linked if linked in stored else None,
                "error": None, **_NOBODYS, "anew": plan.anew or (one.setting.label, *one.key) in anew,
            }  # fmt: skip
            if after[key]["episode_id"] is None:
                to_run[one] = after[key]
        if is_shared:
            _check_orders(study, to_run)
        last = connection.scalar(sa.select(sa.func.max(WANTED.c.block)).where(WANTED.c.study_id == number)) or 0
        blocks = blocks_of({one.key: one for one in to_run}.values(), study.block)
        block_of = {one.key: index for index, block in enumerate(blocks, last + 1) for one in block.episodes}
        for one, row in to_run.items():
            row["block"] = block_of[one.key]
        _replace(connection, before, after)


_KEY = ("setting_id", "task", "seed")
_NOBODYS = {"block": None, "worker": None, "attempts": 0}


def _key(row: Any) -> tuple[int, str, int]:
    return row.setting_id, row.task, row.seed


def _values(row: Any) -> dict[str, Any]:
    return {column.name: getattr(row, column.name) for column in WANTED.c}


def _replace(connection: sa.Connection, before: Mapping[Any, Any], after: Mapping[Any, Any]) -> None:
    """Write the rows of a study in which `after` differs from `before`."""
    same_row = [WANTED.c[name] == sa.bindparam(f"of_{name}") for name in _KEY]
    gone = [dict(zip(map("of_{}".format, _KEY), key, strict=True)) for key in before if before[key] != after.get(key)]
    new = [row for key, row in after.items() if row != before.get(key)]
    if gone:
        connection.execute(sa.delete(WANTED).where(*same_row), gone)
    if new:
        connection.execute(sa.insert(WANTED), new)


def _is_unfinished(row: Mapping[str, Any]) -> bool:
    return row["block"] is not None and row["episode_id"] is None and row["error"] is None


def _still_asked_for(rows: Mapping[Any, dict[str, Any]], wanted: Iterable[tuple[int, str, int]]) -> dict[Any, Any]:
    """Return the rows of tasks outside the plan that stay in the study. Unfinished ones leave the queue."""
    tasks, seeds = set[str](), defaultdict[int, list[int]](list)
    for number, task, seed in wanted:
        tasks.add(task)
        seeds[number].append(seed)
    spans = {number: range(min(some), max(some) + 1) for number, some in seeds.items()}
    kept = {}
    for key, row in rows.items():
        number, task, seed = key
        if task not in tasks and seed in spans.get(number, ()):
            kept[key] = row | _NOBODYS if _is_unfinished(row) else row
    return kept


def _check_orders(study: Study, to_run: Mapping[Episode, object]) -> None:
    for part in ordered_parts(study.episodes, study.block):
        if 0 < sum(one in to_run for one in part) < len(part):
            raise UsageError(
                f"study {study.name} is running, and {part[0].setting.label} adapts from episode to episode: "
                "wait until it has ended"
            )


def _save_settings(connection: sa.Connection, study: Study, is_shared: bool) -> tuple[int, dict[str, int]]:
    """Write a study's row and its settings. Return the row's number, and the settings' row numbers by label.

    Stored settings that the study no longer has, or whose hash changed, are first deleted with their rows in WANTED; if
    the baseline is among them, all settings are deleted. Nothing is deleted while another process runs the study.
    """
    about = {name: getattr(study, name) for name in ABOUT}
    number = _put(connection, STUDIES, {"name": study.name}, {"about": about}, kind=study.kind, created=now())
    stored = sa.select(SETTINGS.c.label, SETTINGS.c.work).where(SETTINGS.c.study_id == number)
    works: dict[str, str] = dict(connection.execute(stored).all())
    if not is_shared:
        kept = [one.label for one in study.settings if works.get(one.label) == one.work]
        kept = kept if study.baseline in kept else []
        connection.execute(sa.delete(SETTINGS).where(SETTINGS.c.study_id == number, SETTINGS.c.label.not_in(kept)))
    ids = {}
    for position, setting in enumerate(study.settings):
        if is_shared and works.get(setting.label, setting.work) != setting.work:
            raise UsageError(
                f"study {study.name} is running, with other settings of {setting.label}: wait until it has ended, or "
                "write a study of another name"
            )
        values = {
            "work": setting.work,
            "position": position,
            "name": setting.name,
            "method": str(setting.settings["method"]),
            "varies": dict(setting.varies),
            "overrides": list(setting.overrides),
            "settings": dict(setting.settings),
            "identity": dict(setting.identity),
        }
        ids[setting.label] = _put(connection, SETTINGS, {"study_id": number, "label": setting.label}, values)
    return number, ids


def _put(
    connection: sa.Connection, table: sa.Table, key: Mapping[str, Any], values: Mapping[str, Any], **first: Any
) -> int:
    """Change the row with this key, or insert one that also has the values `first`. Return its number."""
    changed = sa.update(table).filter_by(**key).values(**values).returning(table.c.id)
    new = sa.insert(table).values(**key, **values, **first).returning(table.c.id)
    return int(connection.scalar(changed) or connection.scalar(new))


def _other_commands(study: Study, alive: Mapping[str, str], run: str) -> sa.ColumnElement[bool]:
    """Return the SQL condition that another living command runs the study."""
    others = RUNS.c.id.in_(set(alive.values()) - {run})
    return sa.exists().where(RUNS.c.kind == study.kind, RUNS.c.name == study.name, others)


def withdraw(plan: Plan, run: str) -> None:
    """Take the study's unfinished episodes out of the queue, so that workers elsewhere end.

    Episodes that those workers run now stay. If another command runs the study, nothing changes.
    """
    study = plan.study
    with study.database.writing() as connection:
        alive = living(study.database, connection)
        mine = sa.select(STUDIES.c.id).where(STUDIES.c.name == study.name).scalar_subquery()
        others = [name for name, whose in alive.items() if whose != run]
        free = sa.or_(WANTED.c.worker.is_(None), WANTED.c.worker.not_in(others))
        idle = sa.update(WANTED).where(WANTED.c.study_id == mine, UNFINISHED, free)
        connection.execute(idle.where(~_other_commands(study, alive, run)).values(**_NOBODYS))
