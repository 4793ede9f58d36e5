"""Studies of another kerv.db: what `kerv runs export --to db` writes, or the database of another results folder."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import write_folder
from kerv_cli.base.foreign import connect_foreign, foreign_table
from kerv_cli.base.limits import check_label
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.lab.database import (
    ABOUT,
    BLOCKS,
    DECODES,
    EPISODES,
    FILE,
    MEASURES,
    RUNS,
    SCHEMA,
    SETTINGS,
    STUDIES,
    WANTED,
    Database,
)
from kerv_cli.lab.plan import Setting, Study, Wanted
from kerv_cli.lab.store import Foreign, StudyStore

_DAMAGE = (sa.exc.SQLAlchemyError, sqlite3.Error, pa.ArrowException, OSError, ValueError, KeyError, TypeError)
_ROW = (*(column.name for column in MEASURES), "order", "started", "worker_pid")


@dataclass
class StoredStudy:
    """A study of a database. command: the words after `kerv` that ran it last."""

    connection: sa.Connection
    study: Study
    settings: dict[int, Setting]  # id in the database -> setting
    command: tuple[str, ...]

    def episodes(self) -> Iterator[Foreign]:
        """Yield its episodes.

        Raises:
            ValueError: The decodes of one are damaged or too large.
        """
        query = (
            sa.select(
                WANTED.c.setting_id, WANTED.c.task, WANTED.c.seed, WANTED.c.repeat,
                *(EPISODES.c[name] for name in _ROW), EPISODES.c.block, BLOCKS.c.run, BLOCKS.c.code, BLOCKS.c.seeds,
                BLOCKS.c.about, DECODES.c.parquet,
            )
            .select_from(WANTED.join(EPISODES).join(BLOCKS).join(DECODES, DECODES.c.episode_id == EPISODES.c.id))
            .where(WANTED.c.setting_id.in_(self.settings))
            .order_by(WANTED.c.position)
        )  # fmt: skip
        for row in self.connection.execution_options(yield_per=100).execute(query).mappings():
            wanted = Wanted(self.settings[row["setting_id"]], row["task"], row["seed"], row["repeat"])
            decodes = foreign_table(row["parquet"]).cast(DECODE_SCHEMA)
            values = {name: row[name] for name in _ROW}
            yield Foreign(
                wanted, values, decodes, row["block"], row["about"], row["run"], row["seeds"], row["code"]
            )  # fmt: skip


def studies_in(connection: sa.Connection, name: str | None = None) -> list[StoredStudy]:
    """Return the studies of a database, or the one of a name, the oldest first."""
    query = sa.select(STUDIES).order_by(STUDIES.c.id)
    found = []
    for row in connection.execute(query if name is None else query.where(STUDIES.c.name == name)).all():
        of_study = sa.select(SETTINGS).where(SETTINGS.c.study_id == row.id).order_by(SETTINGS.c.position)
        settings = {
            one.id: Setting(check_label(one.label), one.overrides, one.settings, one.identity, one.varies, one.name)
            for one in connection.execute(of_study)
        }
        wants = sa.select(WANTED).where(WANTED.c.setting_id.in_(settings)).order_by(WANTED.c.position)
        wanted = tuple(
            Wanted(settings[one.setting_id], one.task, one.seed, one.repeat) for one in connection.execute(wants)
        )
        study = Study(row.name, tuple(settings.values()), wanted, row.kind, **row.about)
        newest = sa.select(RUNS.c.command).where(RUNS.c.kind == row.kind, RUNS.c.name == row.name)
        command = connection.scalar(newest.order_by(RUNS.c.started.desc(), RUNS.c.id.desc()))
        found.append(StoredStudy(connection, study, settings, tuple(command or ())))
    return found


def import_database(results: Database, path: Path, name: str = "") -> tuple[list[str], list[str]]:
    """Copy the studies of another database -> (their names, lines about those that are left out).

    Args:
        results: Where they go.
        path: The other database's file.
        name: Of the study here; empty: as there.

    Raises:
        UsageError: A name for several studies. CheckpointError: The file is damaged, or of a newer kerv.
    """
    engine = sa.create_engine(
        "sqlite://", creator=lambda: connect_foreign(path, check_same_thread=False), poolclass=sa.pool.NullPool
    )
    names, notes = [], []
    try:
        with engine.connect() as connection:
            version = int(connection.scalar(sa.select(ABOUT.c.value).where(ABOUT.c.key == "schema_version")) or 0)
            if version > SCHEMA:
                raise CheckpointError(
                    f"{path} is of a newer kerv (schema {version}, this one reads {SCHEMA}): update kerv"
                )
            there = studies_in(connection)
            if name and len(there) != 1:
                raise UsageError(f"name={name}: {path} holds {len(there)} studies, a name is for one")
            for one in there:
                store = StudyStore(results, name or one.study.name, one.study.kind)
                if take(store, one.study, _told(path, one.episodes()), one.command or ("runs", "import", str(path))):
                    names.append(store.name)
                else:
                    notes.append(left_out(store))
    except _DAMAGE as error:
        raise _damaged(path, error) from error
    return names, notes


def _told(path: Path, episodes: Iterator[Foreign]) -> Iterator[Foreign]:
    """Yield the episodes; an error of reading them names the file that they are from."""
    try:
        yield from episodes
    except _DAMAGE as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> CheckpointError:
    why = " ".join(str(getattr(error, "orig", error)).split())[:160]
    why = "reading it takes too long" if why == "interrupted" else why
    return CheckpointError(f"{path} is damaged or no kerv.db: {why}")


def take(store: StudyStore, study: Study, episodes: Iterator[Foreign], command: tuple[str, ...]) -> bool:
    """Write a study under the store's name -> False if one of that name has episodes already."""
    was_there = store.is_there
    if was_there and store.counts()[0]:
        return False
    try:
        store.add(study, episodes, command)
    except BaseException:
        if not was_there:
            store.remove()
        raise
    return True


def left_out(store: StudyStore) -> str:
    """Return the line about a study that `take` refused."""
    return f"{store.name} is there already and was left out: 'kerv runs rm {store.name}' removes it"


def export_database(store: StudyStore, folder: Path) -> Path:
    """Write a kerv.db with one study into `folder`, in place of an older one -> its file.

    Raises:
        StorageError: The disk refused.
    """

    def fill(new: Path) -> None:
        target = Database(new, f"sqlite:///{new.absolute() / FILE}")
        with store.database.reading() as connection:
            (one,) = studies_in(connection, store.name)
            StudyStore(target, store.name, one.study.kind).add(one.study, one.episodes(), one.command)
        target.close()

    if folder.is_dir() and any(path.name != FILE for path in folder.iterdir()):
        raise UsageError(f"{folder} holds other files: choose another folder with --dir")
    write_folder(folder, fill, replace=True)
    return folder / FILE
