"""Studies in the database: their settings, their episodes, and what is missing of a study."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_label, check_name
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.lab.database import BLOCKS, DECODES, EPISODES, MEASURES, RUNS, SETTINGS, STUDIES, WANTED, Database, now
from kerv_cli.lab.plan import NEVER, Block, Episode, Key, Setting, StoredEpisode, Study, blocks_of, split
from kerv_cli.lab.runs import Run, run_rows

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

SWEEP, ROLLOUT, IMPORT = "sweep", "rollout", "import"
"""Kinds of studies, made by `kerv sweep`, `kerv rollout` and `kerv runs import`."""
_FOLDERS = {SWEEP: "studies", ROLLOUT: "rollouts", IMPORT: "studies"}
_AT_ONCE = 500  # values of an IN (...)
_ABOUT = ("title", "baseline", "axis", "note", "block")
PROVENANCE = ("host", "device_name", "git_commit", "engine", "executor", "workers")
"""Columns of an episode's block that tables show, besides versions."""


@dataclass(frozen=True)
class ImportedEpisode:
    """An episode that another program or another database has.

    Attributes:
        episode: The episode of the study.
        row: Columns of the table `episodes`, as far as they are known.
        decodes: Table with the columns of rows.DECODE_SCHEMA.
        block: Id of the block in which settings took turns.
        about: Provenance of that block.
        run: Id of the run. Empty: that of the import.
        seeds: Seeds of the block, as `seeds_text` writes them.
        code: Hash of the code that ran it.
    """

    episode: Episode
    row: Mapping[str, Any]
    decodes: pa.Table
    block: str
    about: Mapping[str, Any]
    run: str = ""
    seeds: str = ""
    code: str = ""


class StudyStore:
    """A study in the database of a results folder, and its folder of files.

    The folder holds recordings and the report.

    Args:
        results: The results folder, or its database.
        name: Name of the study.
        kind: sweep, rollout or import. Default: as the database says, else sweep.

    Raises:
        UsageError: The name is not a plain folder name.
    """

    def __init__(self, results: Path | str | Database, name: str, kind: str = "") -> None:
        self.database = results if isinstance(results, Database) else Database(results)
        self.name = check_name(name, "study name")
        self._kind = kind

    @property
    def kind(self) -> str:
        """sweep, rollout or import."""
        if not self._kind:
            row = self._row()
            self._kind = SWEEP if row is None else row.kind
        return self._kind

    @property
    def root(self) -> Path:
        """Folder of its files."""
        return self.database.results / _FOLDERS[self.kind] / self.name

    @property
    def rollouts(self) -> Path:
        """Folder of its recordings."""
        return self.root / "rollouts"

    @property
    def recordings(self) -> list[Path]:
        """Its .rrd files, by name."""
        return sorted(self.rollouts.glob("[!.]*.rrd"))

    @property
    def exists(self) -> bool:
        """Whether the database has the study."""
        return self._row() is not None

    def _row(self) -> Any:
        with self.database.reading() as connection:
            return connection.execute(sa.select(STUDIES).where(STUDIES.c.name == self.name)).first()

    def how_to_run(self) -> str:
        """Return the command that runs it, for messages."""
        return f"run `{self.sweep_command()}`" if self.kind == SWEEP else f"run `kerv runs rerun {self.name}`"

    def sweep_command(self, *overrides: str) -> str:
        """Return the newest command that swept the study, or `kerv sweep study=NAME`, with further overrides."""
        typed = (row.command for row in run_rows(self.database, SWEEP, self.name) if row.command[:1] == ("sweep",))
        words: Iterable[str] = next(typed, ("sweep", f"study={self.name}"))
        words = (word for word in words if not word.startswith(("results=", "rerun=", "-")))
        return shlex.join(["kerv", *words, *overrides])

    def load(self) -> Study:
        """Return the study as it was planned last.

        Raises:
            UsageError: There is no such study. The message says what to run.
        """
        row = self._row()
        if row is None:
            raise UsageError(f"no study '{self.name}' in {self.database.shown}: {self.how_to_run()}")
        with self.database.reading() as connection:
            return stored_study(connection, row)[0]

    def save(self, study: Study, existing: Mapping[Episode, StoredEpisode] | None = None, whole: bool = True) -> None:
        """Write a study's settings and episodes.

        Settings that did not change keep their episodes of other tasks, if these have the new seeds and repeats. So
        sweeps of one study over different tasks end in one report.

        Args:
            study: The study.
            existing: Rows of its episodes that the database has.
            whole: Replace the study that is stored. False: add to it.
        """
        with self.database.writing() as connection:
            self._save(connection, study, existing or {}, whole)

    def _save(
        self, connection: sa.Connection, study: Study, existing: Mapping[Episode, StoredEpisode], whole: bool
    ) -> None:
        about = {name: getattr(study, name) for name in _ABOUT}
        row = connection.execute(sa.select(STUDIES).where(STUDIES.c.name == self.name)).first()
        if row is None:
            new = sa.insert(STUDIES).values(name=self.name, kind=study.kind, created=now(), about=about)
            row = connection.execute(new.returning(STUDIES)).one()
        if whole:
            kept = study.labels if row.about["baseline"] == study.baseline else []
            mine = SETTINGS.c.study_id == row.id
            connection.execute(sa.delete(SETTINGS).where(mine, SETTINGS.c.label.not_in(kept)))
            connection.execute(sa.update(STUDIES).where(STUDIES.c.id == row.id).values(about=about))
        ids = {
            setting.label: _save_setting(connection, row.id, position, setting)
            for position, setting in enumerate(study.settings)
        }
        for label, number in ids.items() if whole else ():
            seeds = [one.seed for one in study.episodes if one.setting.label == label]
            repeats = [one.repeat for one in study.episodes if one.setting.label == label]
            still = sa.and_(
                WANTED.c.task.not_in(study.tasks),
                WANTED.c.seed.between(min(seeds, default=0), max(seeds, default=-1)),
                WANTED.c.repeat <= max(repeats, default=-1),
            )
            connection.execute(sa.delete(WANTED).where(WANTED.c.setting_id == number, sa.not_(still)))
        last = sa.select(sa.func.max(WANTED.c.position)).where(WANTED.c.setting_id.in_(ids.values()))
        first = (connection.scalar(last) or 0) + 1
        rows = [
            {
                "setting_id": ids[one.setting.label],
                "task": one.task,
                "seed": one.seed,
                "repeat": one.repeat,
                "position": position,
                "episode_id": existing[one].id if one in existing else None,
            }
            for position, one in enumerate(dict.fromkeys(study.episodes), first)
        ]
        if rows:
            connection.execute(sa.insert(WANTED), rows)

    def counts(self) -> tuple[int, int]:
        """Return the number of episodes that exist, and of all."""
        with self.database.reading() as connection:
            row = connection.execute(
                sa.select(sa.func.count(WANTED.c.episode_id), sa.func.count())
                .select_from(WANTED.join(SETTINGS).join(STUDIES))
                .where(STUDIES.c.name == self.name)
            ).one()
        return int(row[0]), int(row[1])

    def frame(self, episodes: Iterable[Episode] | None = None) -> pd.DataFrame:
        """Return the episodes that exist, in the study's order: a row per label, task, seed and repeat.

        The columns are those of the table `episodes`, with `decode_seconds` as an array, then `run`, `code` and the
        provenance of the block.

        Args:
            episodes: Only these.
        """
        import numpy as np
        import pandas as pd

        keys = ("label", "task", "seed", "repeat")
        measures = [EPISODES.c[column.name] for column in MEASURES]
        circumstances = [EPISODES.c[name] for name in ("block", "order", "started", "decode_seconds")]
        query = (
            sa.select(
                SETTINGS.c.label, WANTED.c.task, WANTED.c.seed, WANTED.c.repeat, EPISODES.c.id.label("episode"),
                *measures, *circumstances, BLOCKS.c.run, BLOCKS.c.code, BLOCKS.c.about,
            )
            .select_from(WANTED.join(EPISODES).join(BLOCKS).join(SETTINGS).join(STUDIES))
            .where(STUDIES.c.name == self.name)
            .order_by(WANTED.c.position)
        )  # fmt: skip
        with self.database.reading() as connection:
            frame = pd.DataFrame(connection.execute(query).mappings().all())
        if frame.empty:
            return frame
        if episodes is not None:
            chosen = {(one.setting.label, one.task, one.seed, one.repeat) for one in episodes}
            frame = frame[[key in chosen for key in zip(*(frame[name] for name in keys), strict=True)]]
        numbers = [
            column.name
            for column in MEASURES
            if isinstance(column.type, sa.Double)
            or (isinstance(column.type, sa.BigInteger) and frame[column.name].isna().any())
        ]
        frame = frame.astype(dict.fromkeys(numbers, float))
        frame["decode_seconds"] = frame["decode_seconds"].map(lambda blob: np.frombuffer(blob, "<f8"))
        about = pd.DataFrame(list(frame.pop("about")), index=frame.index)
        return pd.concat([frame, about], axis=1).reset_index(drop=True)

    def decodes(self, episodes: Sequence[int], columns: Sequence[str] | None = None) -> pa.Table:
        """Return the decodes of some episodes, with their index in the list as the column `episode`.

        Args:
            episodes: Row numbers of the episodes.
            columns: Columns to read. Default: all.
        """
        import pyarrow as pa

        from kerv_cli.episodes.rows import read_decodes

        blobs: dict[int, bytes] = {}
        with self.database.reading() as connection:
            for first in range(0, len(episodes), _AT_ONCE):
                part = [int(number) for number in episodes[first : first + _AT_ONCE]]
                found = connection.execute(sa.select(DECODES).where(DECODES.c.episode_id.in_(part)))
                blobs |= {row.episode_id: row.parquet for row in found}
        tables = []
        for index, number in enumerate(episodes):
            table = read_decodes(blobs[int(number)], columns and list(columns))
            tables.append(table.append_column("episode", pa.array([index] * table.num_rows, pa.int64())))
        return pa.concat_tables(tables, promote_options="default")

    def add(self, study: Study, episodes: Iterable[ImportedEpisode], command: Sequence[str]) -> None:
        """Write a study whose episodes ran elsewhere, in one transaction.

        Args:
            study: Its settings and all its episodes.
            episodes: Those that exist.
            command: Words after `kerv`, for the row of the run.
        """
        from kerv_cli.episodes.rows import seconds_blob, table_blob

        with Run(self.database, study.kind, self.name, command) as record, self.database.writing() as connection:
            self._save(connection, study, {}, whole=True)
            blocks = set(connection.scalars(sa.select(BLOCKS.c.id)))
            for one in episodes:
                if one.block not in blocks:
                    blocks.add(one.block)
                    values = {"seeds": one.seeds, "started": one.row.get("started") or now()}
                    values |= {"code": one.code, "about": one.about, "run": one.run or record.id}
                    connection.execute(sa.insert(BLOCKS).values(id=one.block, **values))
                work, task, seed, repeat = one.episode.key
                key = {"work": work, "task": task, "seed": seed, "repeat": repeat, "block": one.block}
                number = connection.scalar(
                    sa.select(EPISODES.c.id).where(*(EPISODES.c[name] == value for name, value in key.items()))
                )
                if number is None:
                    seconds = seconds_blob(one.decodes["seconds"].to_pylist())
                    row = {"order": 0, "started": "", **one.row, **key, "decode_seconds": seconds}
                    number = insert_episode(connection, row, table_blob(one.decodes))
                connection.execute(self.update_of(one.episode).values(episode_id=number))

    def update_of(self, one: Episode) -> sa.Update:
        """Return the UPDATE of an episode's rows in the study; labels of equal settings share the episode."""
        settings = sa.select(SETTINGS.c.id).join(STUDIES).where(STUDIES.c.name == self.name)
        settings = settings.where(SETTINGS.c.work == one.setting.work)
        same = (WANTED.c.task == one.task, WANTED.c.seed == one.seed, WANTED.c.repeat == one.repeat)
        return sa.update(WANTED).where(WANTED.c.setting_id.in_(settings), *same)

    def remove(self) -> None:
        """Delete the study, and its episodes that no other study has."""
        used = sa.select(WANTED.c.episode_id).where(WANTED.c.episode_id.is_not(None))
        with self.database.writing() as connection:
            mine = used.select_from(WANTED.join(SETTINGS).join(STUDIES)).where(STUDIES.c.name == self.name)
            ids = list(connection.scalars(mine))
            connection.execute(sa.delete(STUDIES).where(STUDIES.c.name == self.name))
            for first in range(0, len(ids), _AT_ONCE):
                part = EPISODES.c.id.in_(ids[first : first + _AT_ONCE])
                connection.execute(sa.delete(EPISODES).where(part, EPISODES.c.id.not_in(used)))
            full = sa.select(EPISODES.c.block)
            connection.execute(sa.delete(BLOCKS).where(BLOCKS.c.id.not_in(full), BLOCKS.c.claim.is_(None)))


def _save_setting(connection: sa.Connection, study: int, position: int, setting: Setting) -> int:
    """Write a setting and return its id. One of the same label and other work is replaced, with its episodes."""
    values = {
        "position": position,
        "name": setting.name,
        "method": str(setting.settings["method"]),
        "varies": dict(setting.varies),
        "overrides": setting.overrides,
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


def insert_episode(connection: sa.Connection, row: Mapping[str, Any], decodes: bytes) -> int:
    """Write an episode and its decodes, and return its row number."""
    number = connection.execute(sa.insert(EPISODES).values(row).returning(EPISODES.c.id)).scalar_one()
    connection.execute(sa.insert(DECODES).values(episode_id=number, parquet=decodes))
    return int(number)


def _setting_of(row: Any) -> Setting:
    return Setting(check_label(row.label), row.overrides, row.settings, row.identity, row.varies, row.name)


def stored_study(connection: sa.Connection, row: Any) -> tuple[Study, dict[int, Setting]]:
    """Return the study of a row of the table `studies`, and its settings by their ids."""
    query = sa.select(SETTINGS).where(SETTINGS.c.study_id == row.id).order_by(SETTINGS.c.position)
    settings = {one.id: _setting_of(one) for one in connection.execute(query)}
    wanted = sa.select(WANTED).where(WANTED.c.setting_id.in_(settings)).order_by(WANTED.c.position)
    episodes = tuple(
        Episode(settings[one.setting_id], one.task, one.seed, one.repeat) for one in connection.execute(wanted)
    )
    return Study(row.name, tuple(settings.values()), episodes, row.kind, **row.about), settings


@dataclass(frozen=True)
class Plan:
    """What a study's database has, what is to run, and how.

    Attributes:
        study: The study.
        store: Where it is stored.
        existing: Episodes that the database has, with their rows.
        missing: Episodes to run, each with the reason.
        newest: Id of the newest row that was read. Later ones are from sweeps that run at the same time.
        runtime: Executor, workers and device.
        command: Words after `kerv` that go on with it.
    """

    study: Study
    store: StudyStore
    existing: Mapping[Episode, StoredEpisode]
    missing: Mapping[Episode, str]
    newest: int = 0
    runtime: RuntimeSettings = field(default_factory=RuntimeSettings)
    command: tuple[str, ...] = ()

    @property
    def to_run(self) -> list[Episode]:
        """The episodes to run. One that two labels share runs once."""
        return list({one.key: one for one in self.missing}.values())

    def blocks(self) -> list[Block]:
        """Return the episodes to run as blocks, in the order of their first episodes."""
        return blocks_of(self.to_run, self.study.block, self.runtime.workers)


def plan_study(
    database: Database,
    study: Study,
    rerun: str = NEVER,
    since: str = "",
    runtime: RuntimeSettings | None = None,
    command: Sequence[str] = (),
) -> Plan:
    """Plan a study: compare its episodes with those of the database.

    Args:
        database: The database.
        study: The study.
        rerun: See `plan.split`.
        since: See `plan.split`.
        runtime: Executor, workers and device.
        command: Words after `kerv` that go on with it.
    """
    stored = stored_episodes(database, study)
    existing, missing = split(study, stored, rerun, since, _earlier(database, study))
    newest = max((row.id for rows in stored.values() for row in rows), default=0)
    store = StudyStore(database, study.name, study.kind)
    return Plan(study, store, existing, missing, newest, runtime or RuntimeSettings(), tuple(command))


def stored_episodes(database: Database, study: Study, newer_than: int = 0) -> dict[Key, list[StoredEpisode]]:
    """Return the rows that a study may use, by key.

    Only a rollout uses the episodes of rollouts. In them no other setting took turns.

    Args:
        database: The database.
        study: The study.
        newer_than: Only rows with a larger id.
    """
    stored: dict[Key, list[StoredEpisode]] = {}
    works = sorted({setting.work for setting in study.settings})
    columns = (
        EPISODES.c.work, EPISODES.c.task, EPISODES.c.seed, EPISODES.c.repeat, EPISODES.c.id, BLOCKS.c.id,
        BLOCKS.c.started, BLOCKS.c.code, BLOCKS.c.seeds,
    )  # fmt: skip
    query = sa.select(*columns).join(BLOCKS, EPISODES.c.block == BLOCKS.c.id).where(EPISODES.c.id > newer_than)
    if study.kind != ROLLOUT:
        query = query.outerjoin(RUNS, RUNS.c.id == BLOCKS.c.run)
        query = query.where(sa.func.coalesce(RUNS.c.kind, "") != ROLLOUT)
    with database.reading() as connection:
        for first in range(0, len(works), _AT_ONCE):
            for row in connection.execute(query.where(EPISODES.c.work.in_(works[first : first + _AT_ONCE]))):
                stored.setdefault(tuple(row[:4]), []).append(StoredEpisode(*row[4:]))
    return stored


def _earlier(database: Database, study: Study) -> dict[str, tuple[Setting, str]]:
    """Return the newest stored setting of each label that has episodes, and its work."""
    ran = sa.select(WANTED.c.setting_id).where(WANTED.c.episode_id.is_not(None))
    query = sa.select(SETTINGS).where(SETTINGS.c.label.in_(study.labels), SETTINGS.c.id.in_(ran))
    with database.reading() as connection:
        rows = connection.execute(query.order_by(SETTINGS.c.id))
        return {row.label: (_setting_of(row), row.work) for row in rows}


def studies(database: Database) -> list[StudyStore]:
    """Return the studies of the database, the newest first."""
    query = sa.select(STUDIES.c.name, STUDIES.c.kind).order_by(STUDIES.c.id.desc())
    with database.reading() as connection:
        return [StudyStore(database, row.name, row.kind) for row in connection.execute(query)]
