"""Plan a study and save its plan: which episodes are in the database, which must run, and in which blocks."""

from __future__ import annotations

import functools
import re
import secrets
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
from kerv_cli.base.runtime import set_up
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.episodes import policy
from kerv_cli.episodes.identity import Setting
from kerv_cli.episodes.resolve import ResolvedStudy, located
from kerv_cli.lab.database import EPISODES, SETTINGS, STUDIES, UNFINISHED, WANTED, Database
from kerv_cli.lab.plan import ALL, NEVER, Block, Episode, all_episodes, blocks_of, ordered_parts, split
from kerv_cli.lab.presence import living
from kerv_cli.lab.read import counts_of, is_stored, rows_of, setting_of, stored_episodes, swept_by
from kerv_cli.lab.runs import interrupted, running
from kerv_cli.lab.store import ABOUT, SWEEP, Study, save_settings, study_row


@dataclass(frozen=True, eq=False)
class Plan:
    """What a command will do for a study.

    Attributes:
        study: The study.
        existing: Row numbers of the episodes that the database has.
        missing: Episodes to run, each with the reason in a few words, such as `new seeds`.
        anew: Whether to run all episodes again.
        seen: Row numbers of the episodes that the study had when it was planned.
        runtime: Workers and device.
        command: Command-line arguments (without `kerv`) that resume the study.
    """

    study: Study
    existing: Mapping[Episode, int]
    missing: Mapping[Episode, str]
    anew: bool = False
    seen: frozenset[int] = frozenset()
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    command: tuple[str, ...] = ()

    @functools.cached_property
    def to_run(self) -> list[Episode]:
        """The episodes to run. An episode that several labels share runs once."""
        return list({one.key: one for one in self.missing}.values())

    @functools.cached_property
    def blocks(self) -> list[Block]:
        """The episodes to run, grouped into blocks. One process runs a block. Blocks are ordered by first episode."""
        return blocks_of(self.to_run, self.study.block, self.runtime.workers or 1)

    @property
    def device(self) -> str:
        devices = {str(one.setting.settings["runtime"]["device"]) for one in self.to_run}
        return devices.pop() if len(devices) == 1 else ""

    @property
    def is_elsewhere(self) -> bool:
        return _is_elsewhere(self.runtime)


def _is_elsewhere(runtime: RuntimeSettings) -> bool:
    return bool(runtime.launch) or not runtime.workers


def check(resolved: ResolvedStudy) -> tuple[Setting, ...]:
    """Check the settings of a sweep or a rollout. Return them with the hashes of their weights, the baseline first."""
    check_writable(str(resolved.first.results))
    settings = []
    for label, one in resolved.settings.items():
        point, device = resolved.points[label], one.runtime.device
        if _is_elsewhere(resolved.first.runtime):  # this machine may have no GPU
            if device == "auto":
                raise UsageError("runtime.device=auto: workers run elsewhere, name their device: cpu or cuda")
            one.runtime.device = "cpu"
        identity = policy.check(one)
        one.runtime.device = device if _is_elsewhere(resolved.first.runtime) else set_up(one.runtime)[0]
        plain = asdict(one)
        del plain["task"]
        settings.append(Setting(label, point.words, plain, identity, point.varies, point.name))
    return tuple(sorted(settings, key=lambda setting: setting.label != resolved.study.baseline))


def plan(
    resolved: ResolvedStudy, settings: Sequence[Setting], database: Database, command: Sequence[str], kind: str = SWEEP
) -> Plan:
    """Find out which episodes of a sweep or a rollout are in the database, and which must run.

    Each call plans a new rollout, unless the same command was interrupted before. Then the rest of its newest rollout
    is planned.

    Args:
        resolved: The study with all its settings.
        settings: What `check` returns.
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
        done, total = counts_of(replace(study, name=begun.name)) if begun else (0, 0)
        begun = begun if 0 < done < total else None
        study = replace(study, name=begun.name if begun else new_name(study))
        rerun, runtime = NEVER if begun else ALL, replace(runtime, workers=1, launch="")
    return plan_study(study, rerun, runtime, command)


def _check_source(study: Study, command: Sequence[str]) -> None:
    """Refuse a sweep if another file, which still exists, already describes a study of this name."""
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
    """Return a name for a new rollout, with date, time and methods: `20260301-142530-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(setting.settings["method"]) for setting in study.settings))
    name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:32]}"
    return f"{name}-{secrets.token_hex(2)}" if is_stored(replace(study, name=name)) else name


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
        stored = stored_episodes(connection, study.kind, {setting.work for setting in study.settings})
        earlier = _earlier(connection, study.labels)
    existing, missing = split(study.episodes, study.block, stored, known, rerun, earlier)
    seen = frozenset(row.episode_id for row in known.values() if row.episode_id is not None)
    return Plan(study, existing, missing, rerun == ALL, seen, runtime or RuntimeSettings(), tuple(command))


def _earlier(connection: sa.Connection, labels: Sequence[str]) -> dict[str, Setting]:
    ran = sa.select(WANTED.c.setting_id).where(WANTED.c.episode_id.is_not(None))
    query = sa.select(SETTINGS).where(SETTINGS.c.label.in_(labels), SETTINGS.c.id.in_(ran)).order_by(SETTINGS.c.id)
    return {row.label: setting_of(row) for row in connection.execute(query)}


def save(plan: Plan, run: str = "") -> None:
    """Write a plan, in one transaction: the study's settings, its rows, and the blocks of what must run.

    If nobody else runs the study, rows outside the plan are removed, or not asked for any more. Sweeps over different
    tasks give one report: rows of another task stay if their setting, the baseline and their seed are in the plan. If
    somebody runs the study, nothing is taken away, and new rows get blocks of their own. A row that finished after
    planning keeps its episode.

    Args:
        plan: The plan.
        run: Id of this command.
    """
    with plan.study.database.writing() as connection:
        save_in(connection, plan, run)


def save_in(connection: sa.Connection, plan: Plan, run: str = "") -> int:
    """Do the same as `save`, but in the caller's transaction. Return the study's row number."""
    study = plan.study
    is_shared = _somebody_runs(connection, study, run)
    number, is_same_baseline = study_row(connection, study)
    ids = save_settings(connection, study, number, is_shared, is_same_baseline)
    before = {(row.setting_id, row.task, row.seed): row for row in rows_of(connection, study.name)}
    works = {setting.work for setting in study.settings}
    stored = set(connection.scalars(sa.select(EPISODES.c.id).where(EPISODES.c.work.in_(works))))
    wanted = {(ids[one.setting.label], one.task, one.seed): one for one in study.episodes}
    new, changed, moved = list[Any](), list[Any](), list[Any]()
    to_run = dict[Episode, dict[str, Any]]()
    positions = _positions(wanted, before)
    for key, one in wanted.items():
        row, linked = before.pop(key, None), plan.existing.get(one)
        of_key = dict(zip(_KEY, key, strict=True))
        if row is not None and _stays(row, linked, plan, is_shared):
            if row.position != positions[key]:
                moved.append({f"of_{name}": value for name, value in (of_key | {"position": positions[key]}).items()})
            continue
        values = {**of_key, "study_id": number, "position": positions[key], "error": None, "block": None,
                  "episode_id": linked if linked in stored else None, "worker": None, "attempts": 0,
                  "anew": plan.anew or (row is not None and row.anew)}  # fmt: skip
        if values["episode_id"] is None:
            to_run[one] = values
        (new if row is None else changed).append(values)
    _check_orders(study, to_run, is_shared)
    last = connection.scalar(sa.select(sa.func.max(WANTED.c.block)).where(WANTED.c.study_id == number)) or 0
    by_key = {one.key: one for one in to_run}
    blocks = blocks_of(by_key.values(), study.block, plan.runtime.workers or 1)
    block_of = {one.key: last + 1 + index for index, block in enumerate(blocks) for one in block.episodes}
    for one, values in to_run.items():
        values["block"] = block_of[one.key]
    if not is_shared:
        _take_away(connection, study, ids, before.values())
    if new:
        connection.execute(sa.insert(WANTED), new)
    if changed:
        rows = [{f"of_{name}": row[name] for name in (*_KEY, *_VALUES)} for row in changed]
        connection.execute(_update(*_VALUES), rows)
    if moved:
        connection.execute(_update("position"), moved)
    return number


_KEY = ("setting_id", "task", "seed")
_VALUES = ("position", "episode_id", "error", "block", "worker", "attempts", "anew")
_OF_KEY = [WANTED.c[name] == sa.bindparam(f"of_{name}") for name in _KEY]


def _update(*names: str) -> sa.Update:
    return sa.update(WANTED).where(*_OF_KEY).values({name: sa.bindparam(f"of_{name}") for name in names})


def _stays(row: Any, linked: int | None, plan: Plan, is_shared: bool) -> bool:
    """Return whether a row of the study stays as it is: it has an episode that counts, or a worker may run it."""
    if row.episode_id is not None:
        return linked is not None or row.episode_id not in plan.seen
    return is_shared and row.is_unfinished


def _positions(wanted: Iterable[tuple[int, str, int]], before: Mapping[tuple[int, str, int], Any]) -> dict[Any, int]:
    """Return the position of each row in the study. The old ones are kept if that is the order of the plan."""
    wanted = list(wanted)
    old = [before[key].position if key in before else None for key in wanted]
    there = [position for position in old if position is not None]
    last = max((row.position for row in before.values()), default=0)
    if there == sorted(there) and None not in old[: len(there)]:
        return dict(zip(wanted, [*there, *range(last + 1, last + 1 + len(old) - len(there))], strict=True))
    return {key: last + number for number, key in enumerate(wanted, 1)}


def _somebody_runs(connection: sa.Connection, study: Study, run: str) -> bool:
    if any(row.id != run for row in running(study.database, connection, study.kind, study.name)):
        return True
    mine = WANTED.join(STUDIES, WANTED.c.study_id == STUDIES.c.id)
    claimed = sa.select(WANTED.c.worker).distinct().select_from(mine).where(STUDIES.c.name == study.name, UNFINISHED)
    return bool(living(study.database, connection).keys() & set(connection.scalars(claimed)))


def _check_orders(study: Study, to_run: Mapping[Episode, object], is_shared: bool) -> None:
    for part in ordered_parts(study.episodes, study.block) if is_shared else ():
        if 0 < sum(one in to_run for one in part) < len(part):
            raise UsageError(
                f"study {study.name} is running, and {part[0].setting.label} adapts from episode to episode: "
                "wait until it has ended"
            )


def _take_away(connection: sa.Connection, study: Study, ids: Mapping[str, int], rows: Iterable[Any]) -> None:
    """Remove rows outside a plan, or let them lose their block. `save` says which."""
    seeds = defaultdict[int, list[int]](list)
    for one in study.episodes:
        seeds[ids[one.setting.label]].append(one.seed)
    spans = {number: (min(some), max(some)) for number, some in seeds.items()}
    tasks, gone, idle = set(study.tasks), [], []
    for row in rows:
        low, high = spans.get(row.setting_id, (0, -1))
        key = {f"of_{name}": getattr(row, name) for name in _KEY}
        if row.task in tasks or not low <= row.seed <= high:
            gone.append(key)
        elif row.is_unfinished:
            idle.append(key)
    if gone:
        connection.execute(sa.delete(WANTED).where(*_OF_KEY), gone)
    if idle:
        connection.execute(sa.update(WANTED).where(*_OF_KEY).values(block=None, worker=None, attempts=0), idle)


def withdraw(plan: Plan, run: str) -> None:
    """Let rows that nobody runs lose their block, so that workers anywhere end when theirs does.

    If another command makes the study, nothing is taken away.
    """
    study = plan.study
    with study.database.writing() as connection:
        if any(row.id != run for row in running(study.database, connection, study.kind, study.name)):
            return
        mine = sa.select(STUDIES.c.id).where(STUDIES.c.name == study.name).scalar_subquery()
        alive = [name for name, whose in living(study.database, connection).items() if whose != run]
        free = sa.or_(WANTED.c.worker.is_(None), WANTED.c.worker.not_in(alive))
        idle = sa.update(WANTED).where(WANTED.c.study_id == mine, UNFINISHED, free)
        connection.execute(idle.values(block=None, worker=None, attempts=0))
