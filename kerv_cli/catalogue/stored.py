"""Copies studies between databases: imports the studies of another kerv.db, and exports one study to a new kerv.db.

SQLite files from others are read with limits on time and size, because a small file can make a query endless.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import regular, write_folder
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
    measures_in,
    newer,
)
from kerv_cli.lab.plan import Episode, Setting, Study
from kerv_cli.lab.store import ImportedEpisode, StudyStore, stored_study
from kerv_cli.worlds.demos.files import foreign_table

_DAMAGE = (sa.exc.SQLAlchemyError, sqlite3.Error, pa.ArrowException, OSError, ValueError, KeyError, TypeError)
_FURTHER = ("order", "started", "worker_pid")
_ROW = (*(column.name for column in MEASURES), *_FURTHER)

MOST_STEPS = 20_000_000
"""Limit on steps of SQLite's virtual machine per connection, about a second. STEPS_PER_BYTE is added."""
STEPS_PER_BYTE = 20
MOST_VALUE = 2**28
"""Limit on the bytes of one value in a SQLite file."""
_EVERY = 10_000


def connect_foreign(path: Path, **options: Any) -> sqlite3.Connection:
    """Open a SQLite file from somebody else, read-only.

    To protect against endless queries, a query fails after a number of steps that depends on the file's size.

    Args:
        path: The file.
        options: Further arguments for `sqlite3.connect`.

    Raises:
        OSError: The file is missing or is not a regular file.
        ValueError: The file is incomplete, or contains views, which could run any query.
    """
    size = regular(path).stat().st_size
    log = path.with_name(f"{path.name}-wal")
    # if its writer was killed, the last rows are in the log, which a connection with immutable=1 would ignore
    immutable = "" if log.is_file() and log.stat().st_size else "&immutable=1"
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{immutable}", uri=True, **options)
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_VALUE)
        left = (MOST_STEPS + STEPS_PER_BYTE * size) // _EVERY

        def count() -> bool:
            nonlocal left
            left -= 1
            return left < 0

        connection.set_progress_handler(count, _EVERY)
        connection.execute("PRAGMA trusted_schema=OFF")
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        if immutable and size < pages * connection.execute("PRAGMA page_size").fetchone()[0]:
            raise ValueError(f"only {size} bytes are there")
        views = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'view'")]
        if views:
            raise ValueError(f"it has the view {views[0][:40]}, which could compute anything")
    except BaseException:
        connection.close()
        raise
    return connection


@dataclass
class Imported:
    """Result of an import: names of the imported studies, and lines of text about what was left out."""

    names: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, store: StudyStore, study: Study, episodes: Iterator[ImportedEpisode], command: Sequence[str]) -> None:
        """Write a study. If the database already has episodes of a study with this name, leave it out and note that.

        Args:
            store: Where the study is written.
            study: The settings and all episodes.
            episodes: The episodes that exist.
            command: Command-line arguments (without `kerv`) that ran the study.
        """
        if store.counts()[0]:
            self.notes.append(f"{store.name} exists and was left out: 'kerv runs rm {store.name}' removes it")
        else:
            store.add(study, episodes, command)
            self.names.append(store.name)

    def leave_out(self, path: Path, error: BaseException) -> None:
        """Note that a damaged study, or a damaged part of one, was left out."""
        self.notes.append(f"{path} was left out: {' '.join(f'{type(error).__name__} {error}'.split())[:160]}")


def check_one(path: Path, name: str, studies: int) -> None:
    """Refuse a new name if there are several studies to name.

    Args:
        path: Where the studies are, for the error message.
        name: The new name. Empty: studies keep their names.
        studies: Number of studies.

    Raises:
        UsageError: A name is given, and the number of studies is not 1.
    """
    if name and studies != 1:
        raise UsageError(f"name={name}: {path} holds {studies} studies, and name= needs exactly one")


def episodes_in(connection: sa.Connection, settings: dict[int, Setting]) -> Iterator[ImportedEpisode]:
    """Yield the stored episodes of some settings in another database.

    Args:
        connection: The other database.
        settings: The settings by their ids in that database.

    Raises:
        ValueError: The decodes of an episode are damaged or too large.
    """
    of_block = BLOCKS.c.id.label("block"), BLOCKS.c.about, BLOCKS.c.run, BLOCKS.c.seeds, BLOCKS.c.code
    stored = [*measures_in(connection), *(EPISODES.c[name] for name in _FURTHER)]
    measures = (column.label(f"row.{name}") for name, column in zip(_ROW, stored, strict=True))
    query = (
        sa.select(WANTED, *measures, *of_block, DECODES.c.parquet)
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
    """Copy all studies of another database file.

    Args:
        results: The database to copy to.
        path: The other database file.
        name: New name of the study, if there is only one. Empty: keep the names.
        imported: Collects the names of imported studies and notes about others.

    Raises:
        UsageError: `name` is given and there are several studies.
        CheckpointError: The file is damaged, or was written by a newer version of kerv.
    """
    engine = sa.create_engine(
        "sqlite://", creator=lambda: connect_foreign(path, check_same_thread=False), poolclass=sa.pool.NullPool
    )
    with _damage(path), engine.connect() as connection:
        version = int(connection.scalar(sa.select(ABOUT.c.value).where(ABOUT.c.key == "schema_version")) or 0)
        if version > SCHEMA:
            raise newer(path, version)
        rows = connection.execute(sa.select(STUDIES).order_by(STUDIES.c.id)).all()
        check_one(path, name, len(rows))
        for row in rows:
            study, settings = stored_study(connection, row)
            store = StudyStore(results, name or study.name, study.kind)
            command = _command(connection, study) or ("runs", "import", str(path))
            imported.add(store, study, _checked(path, episodes_in(connection, settings)), command)


def _command(connection: sa.Connection, study: Study) -> tuple[str, ...]:
    """Return the command-line arguments (without `kerv`) that ran a study last. Empty if none are stored."""
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
    """Write a kerv.db with a single study into a folder, and return the file. An existing kerv.db is replaced.

    Raises:
        UsageError: The folder contains other files.
        StorageError: The disk is full or not writable.
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
