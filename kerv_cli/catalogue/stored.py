"""Studies of another kerv.db: what `kerv runs export --to db` writes, or the database of another results folder."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa
import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import write_folder
from kerv_cli.catalogue.sqlite import connect_foreign
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
    STUDIES,
    WANTED,
    Database,
    newer,
)
from kerv_cli.lab.plan import Episode, Setting, Study
from kerv_cli.lab.store import ImportedEpisode, StudyStore, stored_study
from kerv_cli.worlds.demos.parquet import foreign_table

_DAMAGE = (sa.exc.SQLAlchemyError, sqlite3.Error, pa.ArrowException, OSError, ValueError, KeyError, TypeError)
_ROW = (*(column.name for column in MEASURES), "order", "started", "worker_pid")


@dataclass
class Imported:
    """Names of the studies that were imported, and lines about what was left out."""

    names: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, store: StudyStore, study: Study, episodes: Iterator[ImportedEpisode], command: Sequence[str]) -> bool:
        """Write a study. If one of its name has episodes, leave it out and return False."""
        if store.counts()[0]:
            self.notes.append(f"{store.name} exists and was left out: 'kerv runs rm {store.name}' removes it")
            return False
        store.add(study, episodes, command)
        self.names.append(store.name)
        return True


def episodes_in(connection: sa.Connection, settings: dict[int, Setting]) -> Iterator[ImportedEpisode]:
    """Yield the episodes of a database's settings.

    Args:
        connection: The database.
        settings: Settings of a study by their ids.

    Raises:
        ValueError: The decodes of an episode are damaged or too large.
    """
    of_block = BLOCKS.c.id.label("block"), BLOCKS.c.about, BLOCKS.c.run, BLOCKS.c.seeds, BLOCKS.c.code
    query = (
        sa.select(WANTED, *(EPISODES.c[name].label(f"row.{name}") for name in _ROW), *of_block, DECODES.c.parquet)
        .select_from(WANTED.join(EPISODES).join(BLOCKS).join(DECODES, DECODES.c.episode_id == EPISODES.c.id))
        .where(WANTED.c.setting_id.in_(settings))
        .order_by(WANTED.c.position)
    )
    for row in connection.execution_options(yield_per=100).execute(query).mappings():
        episode = Episode(settings[row["setting_id"]], row["task"], row["seed"], row["repeat"])
        values = {name: row[f"row.{name}"] for name in _ROW}
        decodes = foreign_table(row["parquet"]).cast(DECODE_SCHEMA)
        yield ImportedEpisode(episode, values, decodes, **{column.name: row[column.name] for column in of_block})


def import_database(results: Database, path: Path, name: str, imported: Imported) -> None:
    """Copy the studies of another database.

    Args:
        results: Where they are copied to.
        path: File of the other database.
        name: Name of the study here. Empty: as there.
        imported: Notes what was imported.

    Raises:
        UsageError: `name` is set and there are several studies.
        CheckpointError: The file is damaged, or from a newer kerv.
    """
    engine = sa.create_engine(
        "sqlite://", creator=lambda: connect_foreign(path, check_same_thread=False), poolclass=sa.pool.NullPool
    )
    with _damage(path), engine.connect() as connection:
        version = int(connection.scalar(sa.select(ABOUT.c.value).where(ABOUT.c.key == "schema_version")) or 0)
        if version > SCHEMA:
            raise newer(path, version)
        rows = connection.execute(sa.select(STUDIES).order_by(STUDIES.c.id)).all()
        if name and len(rows) != 1:
            raise UsageError(f"name={name}: {path} holds {len(rows)} studies, a name is for one")
        for row in rows:
            study, settings = stored_study(connection, row)
            store = StudyStore(results, name or study.name, study.kind)
            command = _command(connection, study) or ("runs", "import", str(path))
            imported.add(store, study, _checked(path, episodes_in(connection, settings)), command)


def _command(connection: sa.Connection, study: Study) -> tuple[str, ...]:
    """Return the words after `kerv` that ran a study last."""
    newest = sa.select(RUNS.c.command).where(RUNS.c.kind == study.kind, RUNS.c.name == study.name)
    return tuple(connection.scalar(newest.order_by(RUNS.c.started.desc(), RUNS.c.id.desc())) or ())


def _checked(path: Path, episodes: Iterator[ImportedEpisode]) -> Iterator[ImportedEpisode]:
    with _damage(path):
        yield from episodes


@contextlib.contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        why = " ".join(str(getattr(error, "orig", error)).split())[:160]
        why = "reading it takes too long" if why == "interrupted" else why
        raise CheckpointError(f"{path} is damaged or not a kerv.db: {why}") from error


def export_database(store: StudyStore, folder: Path) -> Path:
    """Write a kerv.db with one study into a folder and return its file. An older one is replaced.

    Raises:
        UsageError: The folder holds other files.
        StorageError: The disk refused.
    """

    def fill(new: Path) -> None:
        copy = Database(new, f"sqlite:///{new.absolute() / FILE}")
        with store.database.reading() as connection:
            row = connection.execute(sa.select(STUDIES).where(STUDIES.c.name == store.name)).one()
            study, settings = stored_study(connection, row)
            episodes = episodes_in(connection, settings)
            StudyStore(copy, study.name, study.kind).add(study, episodes, _command(connection, study))
        copy.close()

    if folder.is_dir() and any(path.name != FILE for path in folder.iterdir()):
        raise UsageError(f"{folder} holds other files: choose another folder with --dir")
    write_folder(folder, fill, replace=True)
    return folder / FILE
