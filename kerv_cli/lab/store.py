"""A study: its settings, its episodes that are in the database, and its missing episodes."""

from __future__ import annotations

import functools
import itertools
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from kerv_cli.base.config import groups
from kerv_cli.base.errors import UsageError, did_you_mean
from kerv_cli.base.limits import check_label
from kerv_cli.base.paths import check_name
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.episodes.identity import Setting
from kerv_cli.lab.database import (
    BLOCKS,
    DECODES,
    EPISODES,
    MEASURES,
    PLANNED,
    RUNS,
    SETTINGS,
    STUDIES,
    WANTED,
    Damaged,
    Database,
    measures_in,
    now,
)
from kerv_cli.lab.plan import NEVER, Block, Episode, Key, StoredEpisode, blocks_of, grouped, split
from kerv_cli.lab.runs import Run, run_rows

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

SWEEP, ROLLOUT = "sweep", "rollout"
"""Kinds of studies, made by `kerv sweep` and `kerv rollout`."""
_FOLDERS = {SWEEP: "studies", ROLLOUT: "rollouts"}
_AT_ONCE = 500  # most values in one SQL IN (…)
_ROWS = 2000  # rows of a frame that are read at a time
ABOUT = ("title", "baseline", "axis", "note", "block", "machines")
"""Fields of a `Study` that are stored as one JSON value."""


@dataclass(frozen=True)
class ImportedEpisode:
    """An episode from another database, to be imported.

    Attributes:
        episode: Setting, task and seed in the study.
        row: Columns of the table `episodes`, as far as they are known.
        decodes: Decodes of the episode, a table with the columns of rows.DECODE_SCHEMA.
        block: Id of the block (episodes that one process ran) in which it ran.
        about: Machine and versions that ran the block.
        run: Id of the run (the command that ran it). If empty, the run that imports the episode is stored.
        seeds: Seeds of the block, as `seeds_text` writes them.
    """

    episode: Episode
    row: Mapping[str, Any]
    decodes: pa.Table
    block: str
    about: Mapping[str, Any]
    run: str = ""
    seeds: str = ""


def _same_episode() -> sa.ColumnElement[bool]:
    """Return the SQL condition that joins a study's planned episodes to all stored rows of the same episodes.

    WANTED joined to SETTINGS has the planned episodes. EPISODES has the stored episodes.
    """
    of_setting = EPISODES.c.work == SETTINGS.c.work, EPISODES.c.task == WANTED.c.task
    return sa.and_(*of_setting, EPISODES.c.seed == WANTED.c.seed)


@dataclass(frozen=True, eq=False)
class Study:
    """A comparison of several settings, in a database.

    `Study(database, name)` alone names a study: `load` returns it with its settings and episodes. `plan` says which of
    its episodes exist and which are missing.

    Attributes:
        database: The database.
        name: Name in the database.
        kind: sweep, rollout or import. If left out, it is read from the database, or sweep if the study is not stored.
        settings: The settings to compare.
        episodes: All episodes, in the order in which they run.
        title: Title of the report.
        baseline: Label of the setting that the others are compared with.
        axis: Configuration key on the x axis of plots. If empty, they show speed and success of each setting.
        note: A sentence printed in the report.
        block: Number of seeds in a block, which one process runs. For each of these seeds it runs all settings.
        machines: Names of cost profiles of other machines, on which the report estimates the speeds.
        existing: Episodes that the database has, with their rows.
        missing: Episodes to run, each with the reason in a few words, such as `new seeds`.
        newest: Largest row number among the stored episodes. Rows with larger numbers are from later sweeps.
        runtime: Executor, workers and device.
        command: Command-line arguments (without `kerv`) that resume the study.

    Raises:
        UsageError: The name is not a plain folder name.
    """

    database: Database
    name: str
    kind: str = ""
    settings: tuple[Setting, ...] = ()
    episodes: tuple[Episode, ...] = ()
    title: str = ""
    baseline: str = ""
    axis: str = ""
    note: str = ""
    block: int = 5
    machines: Sequence[str] = ()
    existing: Mapping[Episode, StoredEpisode] = field(default_factory=dict)
    missing: Mapping[Episode, str] = field(default_factory=dict)
    newest: int = 0
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    command: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_name(self.name, "study name")
        if not self.kind:
            row = self._row()
            object.__setattr__(self, "kind", SWEEP if row is None else row.kind)

    @property
    def labels(self) -> list[str]:
        """Labels of the settings, in order."""
        return [setting.label for setting in self.settings]

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks, in order."""
        return list(dict.fromkeys(map(attrgetter("task"), self.episodes)))

    @functools.cached_property
    def to_run(self) -> list[Episode]:
        """The episodes to run. An episode that several labels share runs once."""
        return list({one.key: one for one in self.missing}.values())

    @functools.cached_property
    def blocks(self) -> list[Block]:
        """The episodes to run, grouped into blocks. One process runs a block. Blocks are ordered by first episode."""
        return blocks_of(self.to_run, self.block, self.runtime.workers)

    @property
    def device(self) -> str:
        """Device of the episodes to run. Empty if they need different devices."""
        devices = {str(one.setting.settings["runtime"]["device"]) for one in self.to_run}
        return devices.pop() if len(devices) == 1 else ""

    @property
    def root(self) -> Path:
        """The study's folder, `<results>/studies/<name>` or `<results>/rollouts/<name>`."""
        return self.database.results / _FOLDERS[self.kind] / self.name

    @property
    def rollouts(self) -> Path:
        """The folder of the study's recordings."""
        return self.root / "rollouts"

    @property
    def recordings(self) -> list[Path]:
        """Paths of the study's .rrd files, sorted by name."""
        return sorted(self.rollouts.glob("[!.]*.rrd"))

    @property
    def exists(self) -> bool:
        """Whether the study is in the database."""
        return self._row() is not None

    def _row(self) -> Any:
        with self.database.reading() as connection:
            return connection.execute(sa.select(STUDIES).where(STUDIES.c.name == self.name)).first()

    def how_to_run(self) -> str:
        """Return advice for error messages on how to run the study, such as: run `kerv sweep study=NAME`."""
        return f"run `{self.sweep_command()}`" if self.kind == SWEEP else f"run `kerv runs rerun {self.name}`"

    def sweep_command(self, *overrides: str) -> str:
        """Return the newest command that ran the study as a sweep, or `kerv sweep study=NAME` if none is stored.

        Args:
            overrides: Further overrides to append. They replace stored overrides of the same keys.
        """
        typed = self._swept() or ("sweep", f"study={self.name}")
        replaced = {"results", "rerun"}
        for word in overrides:
            replaced.add(word.partition("=")[0])
        kept = [word for word in typed if word.partition("=")[0] not in replaced and not word.startswith("-")]
        return shlex.join(["kerv", *kept, *overrides, *self.database.words])

    def _swept(self) -> tuple[str, ...]:
        rows = run_rows(self.database, SWEEP, self.name)
        return next((row.command for row in rows if row.command[:1] == ("sweep",)), ())

    def check_source(self, command: Sequence[str]) -> None:
        """Refuse a sweep whose file has the name of a study that another file describes. A file may have moved."""
        ours, theirs = (
            next((word.partition("=")[2] for word in words if word.startswith("study=")), "")
            for words in (command, self._swept())
        )
        is_there = Path(theirs).is_file() if "/" in theirs else theirs in groups()["study"]
        if is_there and theirs != ours:
            raise UsageError(
                f"study={ours} would replace study '{self.name}' of {theirs} in {self.database.shown}: "
                "choose another study.name=NAME"
            )

    def load(self) -> Study:
        """Return the study as it was planned last.

        Raises:
            UsageError: The database has no such study. The message says which command runs it.
        """
        row = self._row()
        if row is None:
            stored = [study.name for study in studies(self.database)]
            hint = did_you_mean(self.name, stored) or "'kerv runs list' shows what is there"
            hint = self.how_to_run() if self.name in groups()["study"] else hint
            raise UsageError(f"no study '{self.name}' in {self.database.shown}: {hint}")
        with self.database.reading() as connection, self.database.checking(f"study {self.name}"):
            settings, episodes = stored_settings(connection, row.id)
            return Study(self.database, self.name, row.kind, tuple(settings.values()), episodes, **row.about)

    def plan(
        self,
        rerun: str = NEVER,
        since: str = "",
        runtime: RuntimeSettings | None = None,
        command: Sequence[str] = (),
    ) -> Study:
        """Compare the episodes with the database. Return the study with its existing and missing episodes.

        Args:
            rerun: Which existing episodes to run again: NEVER or ALL (`lab/plan.py`).
            since: Used only with ALL, if an interrupted command is resumed: the time at which that command began (ISO
                8601). Episodes of blocks that began then or later do not run again, because that command ran them. If
                empty, all episodes run again.
            runtime: Executor, workers and device.
            command: Command-line arguments (without `kerv`) that resume the study.
        """
        stored = self.stored()
        existing, missing = split(self.episodes, self.block, stored, rerun, since, self._earlier())
        newest = max((row.id for row in itertools.chain(*stored.values())), default=0)
        runtime, command = runtime or RuntimeSettings(), tuple(command)
        return replace(self, existing=existing, missing=missing, newest=newest, runtime=runtime, command=command)

    def stored(self, newer_than: int = 0, block: Block | None = None) -> dict[Key, list[StoredEpisode]]:
        """Return the stored episodes that the study may reuse, by `Episode.key`.

        Sweeps do not reuse episodes of rollouts: no other setting took turns with them, so their times cannot be
        compared.

        Args:
            newer_than: Return only rows with a larger row number.
            block: Return only rows of this block's settings, tasks and seeds. If None, rows of all the settings.
        """
        stored: dict[Key, list[StoredEpisode]] = {}
        columns = (
            EPISODES.c.work, EPISODES.c.task, EPISODES.c.seed, EPISODES.c.id, EPISODES.c.success,
            EPISODES.c.wall_seconds, BLOCKS.c.id, BLOCKS.c.run, BLOCKS.c.started, BLOCKS.c.seeds,
        )  # fmt: skip
        works = {setting.work for setting in (block or self).settings}
        query = sa.select(*columns).join(BLOCKS, EPISODES.c.block == BLOCKS.c.id)
        query = query.where(EPISODES.c.id > newer_than, EPISODES.c.work.in_(works))
        if block is not None:
            tasks = {one.task for one in block.episodes}
            query = query.where(EPISODES.c.task.in_(tasks), EPISODES.c.seed.in_(block.seeds))
        if self.kind != ROLLOUT:
            query = query.outerjoin(RUNS, RUNS.c.id == BLOCKS.c.run)
            query = query.where(sa.func.coalesce(RUNS.c.kind, "") != ROLLOUT)
        with self.database.reading() as connection:
            for work, task, seed, *row in connection.execute(query.order_by(EPISODES.c.id)):
                stored.setdefault((work, task, seed), []).append(StoredEpisode(*row))
        return stored

    def _earlier(self) -> dict[str, Setting]:
        """Return, for each label, the newest stored setting that has episodes."""
        ran = sa.select(WANTED.c.setting_id).where(WANTED.c.episode_id.is_not(None))
        query = sa.select(SETTINGS).where(SETTINGS.c.label.in_(self.labels), SETTINGS.c.id.in_(ran))
        with self.database.reading() as connection:
            rows = connection.execute(query.order_by(SETTINGS.c.id))
            return {row.label: setting_of(row) for row in rows}

    def save(self) -> None:
        """Write the study's settings and its list of planned episodes.

        A study that is stored already may list episodes of tasks that are not in this plan. These episodes stay in the
        list if their setting and the baseline are unchanged, and this plan has their seeds. So sweeps of
        one study over different tasks give one report.
        """
        with self.database.writing() as connection:
            self.save_in(connection)

    def save_in(self, connection: sa.Connection) -> int:
        """Do the same as `save`, but in the caller's transaction. Return the study's row number."""
        about = {name: getattr(self, name) for name in ABOUT}
        row = connection.execute(sa.select(STUDIES).where(STUDIES.c.name == self.name)).first()
        if row is None:
            new = sa.insert(STUDIES).values(name=self.name, kind=self.kind, created=now(), about=about)
            row = connection.execute(new.returning(STUDIES)).one()
        kept = self.labels if row.about["baseline"] == self.baseline else []
        mine = SETTINGS.c.study_id == row.id
        connection.execute(sa.delete(SETTINGS).where(mine, SETTINGS.c.label.not_in(kept)))
        connection.execute(sa.update(STUDIES).where(STUDIES.c.id == row.id).values(about=about))
        ids, of_label = dict[str, int](), grouped(self.episodes, attrgetter("setting.label"))
        for position, setting in enumerate(self.settings):
            ids[setting.label] = _save_setting(connection, row.id, position, setting)
            planned = of_label.get(setting.label, [])
            seeds = list(map(attrgetter("seed"), planned))
            still = sa.and_(
                WANTED.c.task.not_in(self.tasks),
                WANTED.c.seed.between(min(seeds, default=0), max(seeds, default=-1)),
            )
            of_setting = WANTED.c.setting_id == ids[setting.label]
            connection.execute(sa.delete(WANTED).where(of_setting, sa.not_(still)))
        last = sa.select(sa.func.max(WANTED.c.position)).where(WANTED.c.setting_id.in_(ids.values()))
        rows, first = [], (connection.scalar(last) or 0) + 1
        for position, one in enumerate(dict.fromkeys(self.episodes), first):
            stored = self.existing.get(one)
            key = {"setting_id": ids[one.setting.label], "task": one.task, "seed": one.seed}
            rows.append({**key, "position": position, "episode_id": stored and stored.id})
        if rows:
            connection.execute(sa.insert(WANTED), rows)
        return int(row.id)

    def counts(self) -> tuple[int, int]:
        """Return how many of the study's planned episodes have been run, and how many episodes are planned."""
        with self.database.reading() as connection:
            row = connection.execute(
                sa.select(sa.func.count(WANTED.c.episode_id), sa.func.count())
                .select_from(PLANNED)
                .where(STUDIES.c.name == self.name)
            ).one()
        return int(row[0]), int(row[1])

    def version(self) -> str:
        """Return a text that changes whenever episodes of the study are added, replaced or removed."""
        facts = sa.func.count(), sa.func.count(WANTED.c.episode_id), sa.func.sum(WANTED.c.episode_id)
        query = sa.select(*facts).select_from(PLANNED).where(STUDIES.c.name == self.name)
        with self.database.reading() as connection:
            return "/".join(map(str, connection.execute(query).one()))

    def whole_runs(self) -> list[str]:
        """Return the ids of the commands that each ran all episodes of the study, oldest first."""
        wanted = PLANNED.join(EPISODES, _same_episode()).join(BLOCKS)
        keys = WANTED.c.setting_id, WANTED.c.task, WANTED.c.seed
        ran = (
            sa.select(BLOCKS.c.run, *keys).distinct().select_from(wanted).where(STUDIES.c.name == self.name).subquery()
        )
        _, total = self.counts()
        whole = sa.select(ran.c.run).where(ran.c.run != "").group_by(ran.c.run).having(sa.func.count() == total)
        with self.database.reading() as connection:
            return sorted(connection.scalars(whole))

    def frame(self, episodes: Iterable[Episode] | None = None, run: str | None = None) -> pd.DataFrame:
        """Return the episodes that have been run, in the study's order: one row per label, task and seed.

        Its columns are those of the table `episodes`, with `decode_seconds` as an array. Further columns are `run`
        and the machine and versions that ran the episode.

        Args:
            episodes: Only these episodes; None for all.
            run: Only episodes that the command with this id ran. If None, the episodes that the study uses now.
        """
        import numpy as np
        import pandas as pd

        which = WANTED.c.episode_id == EPISODES.c.id if run is None else _same_episode()
        circumstances = EPISODES.c.block, EPISODES.c.order, EPISODES.c.started, EPISODES.c.decode_seconds
        with self.database.reading() as connection, self.database.checking(f"episodes of {self.name}"):
            query = (
                sa.select(
                    SETTINGS.c.label, WANTED.c.task, WANTED.c.seed, EPISODES.c.id.label("episode"),
                    *measures_in(connection), *circumstances, BLOCKS.c.run,
                )
                .select_from(PLANNED.join(EPISODES, which).join(BLOCKS))
                .where(STUDIES.c.name == self.name, *([] if run is None else [BLOCKS.c.run == run]))
                .order_by(WANTED.c.position)
            )  # fmt: skip
            found = connection.execution_options(yield_per=_ROWS).execute(query)
            # part by part: the rows as Python objects take ten times the frame's memory
            parts = [pd.DataFrame.from_records(rows, columns=list(found.keys())) for rows in found.partitions()]
            if not parts:
                return pd.DataFrame()
            frame = pd.concat(parts, ignore_index=True)
            about = self._about_blocks(connection, frame["block"].unique().tolist())
            numbers = [column.name for column in MEASURES if isinstance(column.type, sa.Double | sa.BigInteger)]
            frame[numbers] = frame[numbers].apply(pd.to_numeric)
            unknown = frame[numbers].isna().all()
            frame = frame.astype(dict.fromkeys(unknown.index[unknown], float))
            frame["decode_seconds"] = frame["decode_seconds"].map(lambda blob: np.frombuffer(blob, "<f8"))
        if episodes is not None:
            chosen = [(one.setting.label, one.task, one.seed) for one in episodes]
            frame = frame[pd.MultiIndex.from_frame(frame[["label", "task", "seed"]]).isin(chosen)]
        return frame.join(pd.DataFrame.from_dict(about, orient="index"), on="block").reset_index(drop=True)

    def _about_blocks(self, connection: sa.Connection, blocks: Sequence[str]) -> dict[str, Any]:
        """Return machine and versions of each block, by the block's id."""
        about: dict[str, Any] = {}
        for first in range(0, len(blocks), _AT_ONCE):
            some = BLOCKS.c.id.in_(blocks[first : first + _AT_ONCE])
            about |= {
                row.id: row.about for row in connection.execute(sa.select(BLOCKS.c.id, BLOCKS.c.about).where(some))
            }
        return about

    def decodes(self, episodes: Sequence[int], columns: Sequence[str] | None = None) -> pa.Table:
        """Return the decodes of several episodes in one table. Its column `episode` is an index into `episodes`.

        Args:
            episodes: Row numbers of the episodes.
            columns: Columns to read; None for all.
        """
        import pyarrow as pa

        from kerv_cli.episodes.rows import read_decodes

        blobs: dict[int, bytes] = {}
        with self.database.reading() as connection:
            for first in range(0, len(episodes), _AT_ONCE):
                part = map(int, episodes[first : first + _AT_ONCE])
                found = sa.select(DECODES.c.episode_id, DECODES.c.parquet).where(DECODES.c.episode_id.in_(list(part)))
                for row in connection.execute(found):
                    blobs[row.episode_id] = row.parquet
        tables = []
        with self.database.checking(f"decodes of {self.name}"):
            for index, number in enumerate(episodes):
                table = read_decodes(blobs[int(number)], columns and list(columns))
                tables.append(table.append_column("episode", pa.array([index] * table.num_rows, pa.int64())))
        return pa.concat_tables(tables, promote_options="default")

    def add(self, episodes: Iterable[ImportedEpisode], command: Sequence[str]) -> None:
        """Write the study and its episodes, which were run elsewhere, in one transaction.

        Args:
            episodes: The episodes that were run, with their results.
            command: Command-line arguments (without `kerv`) of the import.
        """
        from kerv_cli.episodes.rows import seconds_blob, table_blob

        with Run(self.database, self.kind, self.name, command) as record, self.database.writing() as connection:
            self.save_in(connection)
            for one in episodes:
                block = {"id": one.block, "seeds": one.seeds, "started": one.row.get("started") or now(),
                         "about": one.about, "run": one.run or record.id}  # fmt: skip
                seconds = seconds_blob(one.decodes["seconds"].to_pylist())
                row = {"order": 0, "started": "", **one.row, "decode_seconds": seconds}
                self.write(connection, one.episode, block, row, table_blob(one.decodes))

    def write(
        self, connection: sa.Connection, one: Episode, block: Mapping[str, Any], row: Mapping[str, Any], decodes: bytes
    ) -> None:
        """Write an episode that has been run, and link it to the study. Rows that exist already are not changed.

        Args:
            connection: The database, in a transaction.
            one: The episode.
            block: Row of its block.
            row: Columns of the table `episodes` whose values are neither in `one` nor in `block`.
            decodes: The episode's decodes, as the bytes of a Parquet file.
        """
        work, task, seed = one.key
        key = {"work": work, "task": task, "seed": seed, "block": block["id"]}
        number = connection.scalar(sa.select(EPISODES.c.id).filter_by(**key))
        if number is None:
            if connection.scalar(sa.select(BLOCKS.c.id).filter_by(id=block["id"])) is None:
                connection.execute(sa.insert(BLOCKS).values(**block))
            new = sa.insert(EPISODES).values({**row, **key}).returning(EPISODES.c.id)
            number = connection.execute(new).scalar_one()
            connection.execute(sa.insert(DECODES).values(episode_id=number, parquet=decodes))
        self.update(connection, one, episode_id=number, error=None)

    def update(self, connection: sa.Connection, one: Episode, **values: Any) -> None:
        """Change this study's rows of an episode in the table WANTED (planned episodes).

        An episode has several rows if settings with different labels have the same hash `work`, and so share it.
        """
        settings = sa.select(SETTINGS.c.id).join(STUDIES).where(STUDIES.c.name == self.name)
        settings = settings.where(SETTINGS.c.work == one.setting.work)
        same = sa.update(WANTED).filter_by(task=one.task, seed=one.seed)
        connection.execute(same.where(WANTED.c.setting_id.in_(settings)).values(**values))

    def remove(self) -> None:
        """Delete the study, and its episodes that no other study uses.

        Also delete episodes that `rerun=all` has replaced, if commands of this study ran them.
        """
        used = sa.select(WANTED.c.episode_id).select_from(PLANNED)
        used = used.where(WANTED.c.episode_id.is_not(None))
        mine, of_others = used.where(STUDIES.c.name == self.name), used.where(STUDIES.c.name != self.name)
        own_runs = sa.select(RUNS.c.id).where(RUNS.c.kind == self.kind, RUNS.c.name == self.name)
        own_blocks = sa.select(BLOCKS.c.id).where(BLOCKS.c.run.in_(own_runs))
        unused = sa.or_(EPISODES.c.id.in_(mine), EPISODES.c.block.in_(own_blocks)), EPISODES.c.id.not_in(of_others)
        with self.database.writing() as connection:
            connection.execute(sa.delete(EPISODES).where(*unused))
            connection.execute(sa.delete(STUDIES).where(STUDIES.c.name == self.name))
            full = sa.select(EPISODES.c.block)
            connection.execute(sa.delete(BLOCKS).where(BLOCKS.c.id.not_in(full)))


def _save_setting(connection: sa.Connection, study: int, position: int, setting: Setting) -> int:
    """Write a setting, and return its id.

    A stored setting with the same label but another hash `work` is deleted first, together with its list of episodes.

    Args:
        connection: The database, in a transaction.
        study: Id of the study.
        position: Place of the setting in the study.
        setting: The setting.
    """
    values = {
        "position": position,
        "name": setting.name,
        "method": str(setting.settings["method"]),
        "varies": dict(setting.varies),
        "overrides": list(setting.overrides),
        "settings": dict(setting.settings),
        "identity": dict(setting.identity),
    }
    same = sa.and_(SETTINGS.c.study_id == study, SETTINGS.c.label == setting.label)
    connection.execute(sa.delete(SETTINGS).where(same, SETTINGS.c.work != setting.work))
    number = connection.scalar(sa.update(SETTINGS).where(same).values(**values).returning(SETTINGS.c.id))
    if number is None:
        new = sa.insert(SETTINGS).values(study_id=study, label=setting.label, work=setting.work, **values)
        number = connection.execute(new.returning(SETTINGS.c.id)).scalar_one()
    return int(number)


def setting_of(row: Any) -> Setting:
    """Return the setting that a row of the table `settings` describes.

    Raises:
        Damaged: The row names no method, or a hash of weights or data in it is not text.
    """
    texts = [row.settings.get("method"), *row.identity.values()]
    if not all(isinstance(text, str) for text in texts):
        raise Damaged(f"the method or the identity of setting {row.label}")
    return Setting(
        check_label(row.label), tuple(map(str, row.overrides)), row.settings, row.identity, row.varies, row.name
    )


def stored_settings(connection: sa.Connection, study: int) -> tuple[dict[int, Setting], tuple[Episode, ...]]:
    """Return a study's settings by their ids, and its episodes. `study` is the study's row number."""
    query = sa.select(SETTINGS).where(SETTINGS.c.study_id == study).order_by(SETTINGS.c.position)
    settings = {one.id: setting_of(one) for one in connection.execute(query)}
    wanted = sa.select(WANTED.c.setting_id, WANTED.c.task, WANTED.c.seed)
    wanted = wanted.where(WANTED.c.setting_id.in_(settings)).order_by(WANTED.c.position)
    return settings, tuple(Episode(settings[number], *rest) for number, *rest in connection.execute(wanted))


def studies(database: Database) -> list[Study]:
    """Return all studies in the database, newest first."""
    query = sa.select(STUDIES.c.name, STUDIES.c.kind).order_by(STUDIES.c.id.desc())
    with database.reading() as connection:
        return [Study(database, row.name, row.kind) for row in connection.execute(query)]
