"""Import studies from other databases."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeAlias

import pyarrow as pa
import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.episodes.identity import Setting
from kerv_cli.episodes.rows import DECODE_SCHEMA, seconds_blob, table_blob
from kerv_cli.lab import database as tables
from kerv_cli.lab.database import FILE, MEASURES, SCHEMA, Database, measures_in, other_schema
from kerv_cli.lab.plan import Episode
from kerv_cli.lab.runs import Run
from kerv_cli.lab.store import Study, planned_episodes, stored_settings, write_episode
from kerv_cli.worlds.demos.files import foreign_table

_DAMAGE = (sa.exc.SQLAlchemyError, sqlite3.Error, pa.ArrowException, OSError, ValueError, KeyError, TypeError,
           AttributeError)  # fmt: skip
_BLOCK = ("about", "run", "seeds")
_FURTHER = ("order", "started")
_ROW = (*map(attrgetter("name"), MEASURES), *_FURTHER)


@dataclass(frozen=True)
class ImportedEpisode:
    """An episode of another database: its columns of the table `episodes`, its decodes, and the row of its block."""

    episode: Episode
    row: Mapping[str, Any]
    decodes: pa.Table
    block: Mapping[str, Any]


# A study with all its planned episodes, those that were run, and the command (without `kerv`) that ran it
Found: TypeAlias = tuple[Study, Iterator[ImportedEpisode], tuple[str, ...]]


def import_databases(database: Database, files: Sequence[Path], name: str = "") -> tuple[list[str], list[str]]:
    """Copy studies, without recordings and artifacts. Those whose name the database already has are left out.

    Args:
        name: New name of the study. Each file must then hold exactly one study.

    Returns:
        Names of the imported studies, and a line of text about each study that was left out.
    """
    names, notes = list[str](), list[str]()
    for file in files:
        if database.file is not None and file.resolve() == database.file.resolve():
            raise UsageError(f"{file} is the database to import into: name another folder with results=")
        with contextlib.ExitStack() as stack:
            found = _in_database(file, database, name, stack)
            if name and len(found) != 1:
                raise UsageError(f"name={name}: {file} holds {len(found)} studies, and name= needs exactly one")
            for study, episodes, command in found:
                if study.counts()[0]:
                    notes.append(f"{study.name} exists and was left out: 'kerv runs rm {study.name}' removes it")
                else:
                    _add(study, episodes, command or ("runs", "import", str(file)))
                    names.append(study.name)
    return names, notes


def database_in(path: Path) -> Path:
    """Return the database file: a file `path` that ends in .db, or kerv.db in a folder `path`."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file() or file.suffix != Path(FILE).suffix:
        raise UsageError(f"{path} holds no database: name a results folder or a kerv.db")
    return file


def _connect(path: Path) -> sqlite3.Connection:
    # read-only; if its writer was killed, the last rows are in the log, which immutable=1 would ignore
    log = path.with_name(f"{path.name}-wal")
    immutable = "" if log.is_file() and log.stat().st_size else "&immutable=1"
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{immutable}", uri=True, check_same_thread=False)


def _in_database(path: Path, database: Database, name: str, stack: contextlib.ExitStack) -> list[Found]:
    engine = sa.create_engine("sqlite://", creator=lambda: _connect(path), poolclass=sa.pool.NullPool)
    with _damage(path):
        connection = stack.enter_context(engine.connect())
        about = tables.ABOUT.c
        version = int(connection.scalar(sa.select(about.value).where(about.key == "schema_version")) or 0)
        if version != SCHEMA:
            raise other_schema(path, version)
        studies = connection.execute(sa.select(tables.STUDIES)).all()
        return [_stored(connection, path, row, database, name) for row in studies]


def _stored(connection: sa.Connection, path: Path, row: Any, database: Database, name: str = "") -> Found:
    settings = stored_settings(connection, row.id)
    episodes = planned_episodes(connection, settings)
    study = Study(database, name or row.name, row.kind, tuple(settings.values()), episodes, **row.about)
    runs = tables.RUNS.c
    newest = sa.select(runs.command).where(runs.kind == row.kind, runs.name == row.name)
    command = connection.scalar(newest.order_by(runs.started.desc(), runs.id.desc()).limit(1))
    return study, _stored_episodes(connection, path, settings), tuple(command or ())


def _stored_episodes(connection: sa.Connection, path: Path, settings: dict[int, Setting]) -> Iterator[ImportedEpisode]:
    blocks, decodes = tables.BLOCKS.c, tables.DECODES
    of_block = blocks.id.label("block"), blocks.about, blocks.run, blocks.seeds
    stored = [*measures_in(connection), *tables.EPISODES.c[_FURTHER]]
    measures = [column.label(f"row.{name}") for name, column in zip(_ROW, stored, strict=True)]
    query = (
        sa.select(*tables.WANTED.c["setting_id", "task", "seed"], *measures, *of_block, decodes.c.parquet)
        .select_from(tables.WANTED.join(tables.EPISODES).join(tables.BLOCKS))
        .join(decodes, decodes.c.episode_id == tables.EPISODES.c.id)
        .where(tables.WANTED.c.setting_id.in_(settings))
        .order_by(tables.WANTED.c.position)
    )
    with _damage(path):
        for row in connection.execution_options(yield_per=100).execute(query).mappings():
            episode = Episode(settings[row["setting_id"]], row["task"], row["seed"])
            values = {name: row[f"row.{name}"] for name in _ROW}
            decoded = foreign_table(row["parquet"]).cast(DECODE_SCHEMA)
            block = {"started": values["started"], "id": row["block"]} | {name: row[name] for name in _BLOCK}
            yield ImportedEpisode(episode, values, decoded, block)


def _add(study: Study, episodes: Iterable[ImportedEpisode], command: Sequence[str]) -> None:
    from kerv_cli.lab.study import Plan, save_in  # imports torch

    with Run(study.database, study.kind, study.name, command) as record, study.database.writing() as connection:
        number = save_in(connection, Plan(study, {}, {}), record.id)
        of_label = sa.select(tables.SETTINGS.c.label, tables.SETTINGS.c.id).where(tables.SETTINGS.c.study_id == number)
        ids: dict[str, int] = dict(connection.execute(of_label).all())
        for one in episodes:
            row = {**one.row, "decode_seconds": seconds_blob(one.decodes["seconds"].to_pylist())}
            stored = write_episode(connection, one.episode.key, one.block, row, table_blob(one.decodes))
            key = {"setting_id": ids[one.episode.setting.label], "task": one.episode.task, "seed": one.episode.seed}
            connection.execute(sa.update(tables.WANTED).filter_by(**key).values(episode_id=stored))
        waiting = sa.update(tables.WANTED).where(tables.WANTED.c.study_id == number, tables.UNFINISHED)
        connection.execute(waiting.values(block=None))


@contextlib.contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        why = " ".join(str(getattr(error, "orig", error)).split())[:160]
        raise CheckpointError(f"{path} is damaged, or not a kerv.db: {why}") from error
