"""Imports results folders, of this version and of 0.1.0, and other databases; exports one study to a new kerv.db.

Version 0.1.0 had no database. It had one folder per study, with plan.yaml, run.json and one folder per cell. A cell is
a setting on one task with a few seeds.

SQLite files from others are read with limits on time and size, because a small file can make a query endless.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.base.files import read_mapping, read_yaml, regular, sha256_of, visible, write_folder
from kerv_cli.base.limits import check_label
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import SETTINGS_GROUPS, part_of
from kerv_cli.episodes.identity import ENGINE
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab import database as tables
from kerv_cli.lab.database import FILE, MEASURES, SCHEMA, Database, measures_in, newer
from kerv_cli.lab.plan import Episode, Setting, Study, plain_settings
from kerv_cli.lab.store import ROLLOUT, SWEEP, ImportedEpisode, StudyStore, stored_study
from kerv_cli.methods.settings import with_artifacts
from kerv_cli.worlds.demos.files import foreign_table

_DAMAGE = (sa.exc.SQLAlchemyError, sqlite3.Error, pa.ArrowException, OSError, ValueError, KeyError, TypeError,
           AttributeError)  # fmt: skip
_FOLDERS = {"studies": SWEEP, "rollouts": ROLLOUT}
_RENAMED = {name: f"{name}_tuned" for name in ("spec_vla", "kerv", "heisd")} | {
    f"{name}_paper": name for name in ("spec_vla", "kerv", "heisd")
}
_NOT_OF_BLOCK = {"state", "episodes", "successes", "seconds", "wall_seconds", "timed", "started", "files", "sha256",
                 "run", "pid", "code"}  # fmt: skip

_FURTHER = ("order", "started", "worker_pid")
_ROW = (*(column.name for column in MEASURES), *_FURTHER)

MOST_STEPS = 20_000_000
"""Limit on steps of SQLite's virtual machine per connection, about a second. STEPS_PER_BYTE is added."""
STEPS_PER_BYTE = 20
MOST_VALUE = 2**28
"""Limit on the bytes of one value in a SQLite file."""
_EVERY = 10_000

Cells = list[tuple[str, list[Episode]]]
"""For each cell (a setting on one task with a few seeds): its id and its episodes."""


def is_results(path: Path) -> bool:
    """Return whether a path is a results folder or a kerv.db.

    Raises:
        UsageError: The path does not exist.
    """
    if not path.exists():
        raise UsageError(
            f"{path} does not exist: name a results folder, a kerv.db, or evaluations of vla-eval or lerobot"
        )
    return _database_of(path) is not None or bool(_older_studies(path))


def _database_of(path: Path) -> Path | None:
    """Return the database file: the path itself, or kerv.db in the folder. None if there is none."""
    file = path / FILE if path.is_dir() else path
    return file if file.is_file() and file.suffix == Path(FILE).suffix else None


def import_results(results: Database, paths: Sequence[Path], name: str = "") -> Imported:
    """Copy the studies of results folders and databases into a database.

    Args:
        results: The database to copy to.
        paths: Results folders of this version or 0.1.0, or database files.
        name: New name of the study, if there is only one. Empty: keep the names.

    Raises:
        UsageError: A path is the results folder itself, or `name` is given and there are several studies.
        CheckpointError: A database is damaged.
    """
    imported = Imported()
    for path in paths:
        older, file = _older_studies(path), _database_of(path)
        if older:
            _import_older(results, path, name, imported)
        if file is not None and (results.file is None or file.resolve() != results.file.resolve()):
            import_database(results, file, name, imported)
        elif not older:
            raise UsageError(f"{path} is the results folder that it would be imported into: name another with results=")
    return imported


def _older_studies(path: Path) -> list[tuple[str, Path]]:
    """Return kind and folder of each study and rollout of version 0.1.0 in a results folder."""
    found = [(kind, plan.parent) for name, kind in _FOLDERS.items() for plan in path.glob(f"{name}/[!.]*/plan.yaml")]
    return sorted(found, reverse=True)


def _import_older(results: Database, path: Path, name: str, imported: Imported) -> None:
    """Copy all studies and rollouts of a results folder of version 0.1.0 into a database.

    Recordings and artifacts are not copied.

    Args:
        results: The database to copy to.
        path: The older results folder.
        name: New name of the study. Empty: keep the names.
        imported: Collects the names of imported studies and notes about damaged ones.

    Raises:
        UsageError: `name` is given and there are several studies.
        StorageError: The disk is full or not writable.
    """
    studies = _older_studies(path)
    check_one(path, name, len(studies))
    for kind, folder in studies:
        store = StudyStore(results, name or folder.name, kind)
        try:
            study, cells = _study_of(folder, store.name, kind)
            run = folder / "run.json"
            commands = read_mapping(run)["commands"] if run.is_file() else []
            words = tuple(commands[-1]["arguments"]) if commands else ("runs", "import", str(path))
        except (*_DAMAGE, KervError) as error:
            imported.leave_out(folder, error)
            continue
        imported.add(store, study, _episodes(folder, cells, imported), words)


def _study_of(folder: Path, name: str, kind: str) -> tuple[Study, Cells]:
    """Return the study that a plan.yaml of version 0.1.0 describes, and the cells with its episodes."""
    plan = read_yaml(folder / "plan.yaml")
    settings = {
        str(label): Setting(
            check_label(str(label)), str(one["overrides"]), completed(one["settings"]), dict(one["identity"])
        )
        for label, one in plan["labels"].items()
    }
    cells = []
    for cell in plan["cells"]:
        setting, task, repeat = settings[str(cell["label"])], str(cell["task"]), int(cell["repeat"])
        ranges = [part.partition("-") for part in str(cell["seeds"]).split(";")]  # "5-7;9" is 5, 6, 7, 9
        seeds = [seed for first, _, last in ranges for seed in range(int(first), int(last or first) + 1)]
        cells.append((str(cell["id"]), [Episode(setting, task, seed, repeat) for seed in seeds]))
    title, baseline, axis, note = (str(plan[key] or "") for key in ("title", "baseline", "axis", "note"))
    if baseline not in settings:
        raise ValueError(f"the baseline '{baseline}' is not one of its settings")
    episodes = tuple(dict.fromkeys(one for _, part in cells for one in part))
    return Study(name, tuple(settings.values()), episodes, kind, title, baseline, axis, note), cells


def completed(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Convert stored settings to the current format, without the task.

    Missing settings get their defaults. Settings that no longer exist are removed. Settings of a part that is not
    installed stay as they are. Our presets have been renamed since 0.1.0, and a draft's shape was its `top_k`.
    """
    stored = {**stored, "method": _RENAMED.get(str(stored.get("method")), stored.get("method"))}
    plain = dataclasses.asdict(read(RolloutSettings, with_artifacts(stored), "a stored setting", tolerant=True))
    for group in SETTINGS_GROUPS:
        value = stored.get(group)
        if isinstance(value, Mapping):
            if value.get("top_k", 1) > 1:
                value = {**value, "shape": "tree"}
            elif value.get("kind") == "drafter":
                value = {key: one for key, one in value.items() if key not in ("top_k", "nodes")}
            plain[group] = dict(value)
            with contextlib.suppress(UnknownName):
                schema = part_of(group, value["kind"]).settings
                plain[group] = dataclasses.asdict(read(schema, value, f"a stored setting's {group}", tolerant=True))
    return plain_settings(plain)


def _episodes(folder: Path, cells: Cells, imported: Imported) -> Iterator[ImportedEpisode]:
    """Yield the episodes of every complete cell. For each damaged cell, add a line to the notes of `imported`."""
    for name, episodes in cells:
        # a cell that ran again has newer folders NAME-2, NAME-3, …
        again = [path for path in visible(folder / "cells") if path.name.startswith(f"{name}-")]
        cell = max(again, key=lambda path: (len(path.name), path.name), default=folder / "cells" / name)
        if not cell.is_dir():
            continue  # it has not run
        try:
            rows = list(_of_cell(cell, episodes))
        except (*_DAMAGE, KervError) as error:
            imported.leave_out(cell, error)
            continue
        yield from rows


def _of_cell(cell: Path, episodes: list[Episode]) -> Iterator[ImportedEpisode]:
    status = read_mapping(cell / "status.json")
    for file, digest in status["files"].items():
        if sha256_of(cell / Path(file).name) != digest:
            raise CheckpointError(f"{file} has changed since it was written")
    if status.get("engine", 1) != ENGINE:
        raise CheckpointError(f"it was decoded by engine version {status['engine']}, this kerv has version {ENGINE}")
    rows = {row["seed"]: row for row in foreign_table(cell / "episodes.parquet").to_pylist()}
    decodes = foreign_table(cell / "decodes.parquet")
    about = {"engine": 1, **{name: value for name, value in status.items() if name not in _NOT_OF_BLOCK}}
    run, code = str(status.get("run", "")), str(status.get("code", ""))
    for one in episodes:
        row = rows[one.seed]
        known = {name: row[name] for name in _ROW if name in row and row[name] == row[name]}  # without NaN
        mine = decodes.filter(pa.compute.equal(decodes["seed"], one.seed))
        # missing columns become null
        table = pa.concat_tables([DECODE_SCHEMA.empty_table(), mine], promote_options="permissive")
        table = table.select(DECODE_SCHEMA.names).cast(DECODE_SCHEMA)
        yield ImportedEpisode(one, known, table, str(row["block"]), about, run, code=code)


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
    blocks, decodes = tables.BLOCKS.c, tables.DECODES
    of_block = blocks.id.label("block"), blocks.about, blocks.run, blocks.seeds, blocks.code
    stored = [*measures_in(connection), *(tables.EPISODES.c[name] for name in _FURTHER)]
    measures = (column.label(f"row.{name}") for name, column in zip(_ROW, stored, strict=True))
    query = (
        sa.select(tables.WANTED, *measures, *of_block, decodes.c.parquet)
        .select_from(tables.WANTED.join(tables.EPISODES).join(tables.BLOCKS))
        .join(decodes, decodes.c.episode_id == tables.EPISODES.c.id)
        .where(tables.WANTED.c.setting_id.in_(settings))
        .order_by(tables.WANTED.c.position)
    )
    for row in connection.execution_options(yield_per=100).execute(query).mappings():
        episode = Episode(settings[row["setting_id"]], row["task"], row["seed"], row["repeat"])
        values = {name: row[f"row.{name}"] for name in _ROW}
        table = foreign_table(row["parquet"]).cast(DECODE_SCHEMA)
        yield ImportedEpisode(episode, values, table, **{column.name: row[column.name] for column in of_block})


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
        about = tables.ABOUT.c
        version = int(connection.scalar(sa.select(about.value).where(about.key == "schema_version")) or 0)
        if version > SCHEMA:
            raise newer(path, version)
        rows = connection.execute(sa.select(tables.STUDIES).order_by(tables.STUDIES.c.id)).all()
        check_one(path, name, len(rows))
        for row in rows:
            study, settings = stored_study(connection, row)
            store = StudyStore(results, name or study.name, study.kind)
            command = _command(connection, study) or ("runs", "import", str(path))
            imported.add(store, study, _checked(path, episodes_in(connection, settings)), command)


def _command(connection: sa.Connection, study: Study) -> tuple[str, ...]:
    """Return the command-line arguments (without `kerv`) that ran a study last. Empty if none are stored."""
    newest = sa.select(tables.RUNS.c.command).where(tables.RUNS.c.kind == study.kind, tables.RUNS.c.name == study.name)
    return tuple(connection.scalar(newest.order_by(tables.RUNS.c.started.desc(), tables.RUNS.c.id.desc())) or ())


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
            row = connection.execute(sa.select(tables.STUDIES).where(tables.STUDIES.c.name == store.name)).one()
            study, settings = stored_study(connection, row)
            episodes = episodes_in(connection, settings)
            StudyStore(copy, study.name, study.kind).add(study, episodes, _command(connection, study))
        copy.close()

    if folder.is_dir() and any(path.name != FILE for path in folder.iterdir()):
        raise UsageError(f"{folder} holds other files: choose another folder with --dir")
    write_folder(folder, fill, replace=True)
    return folder / FILE
