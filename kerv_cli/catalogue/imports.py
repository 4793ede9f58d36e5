"""Import studies from other databases and from results folders of version 0.1.0. Export a study to a new kerv.db.

Version 0.1.0 had no database. It had one folder per study, with plan.yaml, run.json and one folder per cell. A cell is
a setting on one task with a few seeds.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.base.files import read_mapping, read_yaml_lines, regular, visible, write_folder
from kerv_cli.base.limits import check_label
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import SETTINGS_GROUPS, part_of
from kerv_cli.episodes.identity import ENGINE
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab import database as tables
from kerv_cli.lab.database import FILE, MEASURES, SCHEMA, Database, file_url, measures_in, newer
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
_FURTHER = ("order", "started")
_ROW = (*(column.name for column in MEASURES), *_FURTHER)

MOST_STEPS = 20_000_000
"""Limit on steps of SQLite's virtual machine per connection, about a second. It grows by STEPS_PER_BYTE per byte."""
STEPS_PER_BYTE = 20
_EVERY = 10_000


@dataclass(frozen=True)
class Found:
    """A study that can be imported.

    Attributes:
        study: Its settings and the list of all planned episodes.
        episodes: Yields the episodes that were run, with their results.
        command: Command-line arguments (without `kerv`) that ran it. Empty if unknown.
    """

    study: Study
    episodes: Iterator[ImportedEpisode]
    command: tuple[str, ...]


def import_results(results: Database, paths: Sequence[Path], name: str = "") -> tuple[list[str], list[str]]:
    """Copy studies into a database. Studies whose name the database already has are left out.

    Recordings and artifacts are not copied.

    Args:
        results: The database to copy to.
        paths: Results folders of this version or 0.1.0, or database files.
        name: New name of the study. Each path must then hold exactly one. Empty: keep the names.

    Returns:
        Names of the imported studies, and a line of text about each study or cell that was left out.

    Raises:
        UsageError: A path is the folder or file of `results`. Or `name` is given, and a path does not hold exactly one
            study.
        CheckpointError: A database is damaged, or was written by a newer version of kerv.
    """
    names: list[str] = []
    notes: list[str] = []
    for path in paths:
        with contextlib.ExitStack() as stack:
            found, file = list(_in_folder(path, notes)), _database_of(path)
            if file is not None and (results.file is None or file.resolve() != results.file.resolve()):
                found += _in_database(file, stack)
            elif not found and not notes:
                raise UsageError(f"{path} is the results folder to import into: name another with results=")
            if name and len(found) != 1:
                raise UsageError(f"name={name}: {path} holds {len(found)} studies, and name= needs exactly one")
            for one in found:
                store = StudyStore(results, name or one.study.name, one.study.kind)
                if store.counts()[0]:
                    notes.append(f"{store.name} exists and was left out: 'kerv runs rm {store.name}' removes it")
                else:
                    store.add(one.study, one.episodes, one.command or ("runs", "import", str(path)))
                    names.append(store.name)
    return names, notes


def is_results(path: Path) -> bool:
    """Return whether a path is a results folder or a kerv.db.

    Raises:
        UsageError: The path does not exist.
    """
    if not path.exists():
        raise UsageError(f"{path} does not exist: name a results folder, a kerv.db, or a recording of vla-eval")
    return _database_of(path) is not None or any(path.glob("*/*/plan.yaml"))


def _database_of(path: Path) -> Path | None:
    """Return the database file: `path` itself, or kerv.db in it if it is a folder. None if that is no database."""
    file = path / FILE if path.is_dir() else path
    return file if file.is_file() and file.suffix == Path(FILE).suffix else None


def _in_folder(path: Path, notes: list[str]) -> Iterator[Found]:
    """Yield the studies and rollouts of a results folder of version 0.1.0, and note those that are damaged."""
    plans = [(kind, plan.parent) for name, kind in _FOLDERS.items() for plan in path.glob(f"{name}/[!.]*/plan.yaml")]
    for kind, folder in sorted(plans, reverse=True):
        try:
            study, cells = _study_of(folder, kind)
            run = folder / "run.json"
            commands = read_mapping(run)["commands"] if run.is_file() else [{"arguments": ()}]
            yield Found(study, _in_cells(cells, notes), tuple(commands[-1]["arguments"]))
        except (*_DAMAGE, KervError) as error:
            notes.append(_left_out(folder, error))


def _left_out(path: Path, error: BaseException) -> str:
    return f"{path} was left out: {' '.join(f'{type(error).__name__} {error}'.split())[:160]}"


def _study_of(folder: Path, kind: str) -> tuple[Study, dict[Path, list[Episode]]]:
    """Read the plan.yaml of a study of version 0.1.0.

    Returns:
        The study, and the episodes of each of its cells by the cell's folder.
    """
    plan, _ = read_yaml_lines(folder / "plan.yaml", str(folder))
    settings = {
        str(label): Setting(
            check_label(str(label)), str(one["overrides"]), completed(one["settings"]), dict(one["identity"])
        )
        for label, one in plan["labels"].items()
    }
    cells = {}
    for cell in plan["cells"]:
        setting, task, repeat = settings[str(cell["label"])], str(cell["task"]), int(cell["repeat"])
        ranges = [part.partition("-") for part in str(cell["seeds"]).split(";")]  # "5-7;9" is 5, 6, 7, 9
        seeds = [seed for first, _, last in ranges for seed in range(int(first), int(last or first) + 1)]
        cells[folder / "cells" / str(cell["id"])] = [Episode(setting, task, seed, repeat) for seed in seeds]
    title, baseline, axis, note = (str(plan[key] or "") for key in ("title", "baseline", "axis", "note"))
    if baseline not in settings:
        raise ValueError(f"the baseline '{baseline}' is not one of its settings")
    episodes = tuple(dict.fromkeys(one for part in cells.values() for one in part))
    return Study(folder.name, tuple(settings.values()), episodes, kind, title, baseline, axis, note), cells


def completed(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the settings of a rollout of version 0.1.0 to the current format, without the task.

    Missing settings get their defaults. Settings that no longer exist are removed. Settings of a part that is not
    installed stay as they are. Renamed presets get their new names. Drafts with a `top_k` above 1 get `shape=tree`, a
    setting that 0.1.0 did not have.
    """
    stored = {**stored, "method": _RENAMED.get(str(stored.get("method")), stored.get("method"))}
    plain = dataclasses.asdict(read(RolloutSettings, with_artifacts(stored), "a stored setting", tolerant=True))
    for group in SETTINGS_GROUPS:
        value = stored.get(group)
        if isinstance(value, Mapping):
            plain[group] = value = {**value, **({"shape": "tree"} if value.get("top_k", 1) > 1 else {})}
            with contextlib.suppress(UnknownName):
                schema = part_of(group, value["kind"]).settings
                plain[group] = dataclasses.asdict(read(schema, value, f"a stored setting's {group}", tolerant=True))
    return plain_settings(plain)


def _in_cells(cells: Mapping[Path, list[Episode]], notes: list[str]) -> Iterator[ImportedEpisode]:
    """Yield the episodes of a study of 0.1.0. Skip cells that have not run, and describe unreadable ones in `notes`.

    A cell is a folder with the episodes of one setting on one task, for a few seeds.
    """
    for cell, episodes in cells.items():
        # a cell that ran again has newer folders NAME-2, NAME-3, …
        again = [path for path in visible(cell.parent) if path.name.startswith(f"{cell.name}-")]
        newest = max(again, key=lambda path: (len(path.name), path.name), default=cell)
        if not newest.is_dir():
            continue  # it has not run
        try:
            rows = list(_in_cell(newest, episodes))
        except (*_DAMAGE, KervError) as error:
            notes.append(_left_out(newest, error))
            continue
        yield from rows


def _in_cell(cell: Path, episodes: list[Episode]) -> Iterator[ImportedEpisode]:
    status = read_mapping(cell / "status.json")
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

    A small file can contain an endless query. So a connection may execute only a limited number of SQLite's
    instructions, which grows with the file's size. After that, its queries fail.

    Args:
        path: The file.
        options: Further arguments for `sqlite3.connect`.

    Raises:
        OSError: The file is missing or is not a regular file.
        ValueError: The file is incomplete.
    """
    size = regular(path).stat().st_size
    log = path.with_name(f"{path.name}-wal")
    # if its writer was killed, the last rows are in the log, which a connection with immutable=1 would ignore
    immutable = "" if log.is_file() and log.stat().st_size else "&immutable=1"
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{immutable}", uri=True, **options)
    left = (MOST_STEPS + STEPS_PER_BYTE * size) // _EVERY

    def count() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    connection.set_progress_handler(count, _EVERY)
    try:
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        if immutable and size < pages * connection.execute("PRAGMA page_size").fetchone()[0]:
            raise ValueError(f"only {size} bytes are there")
    except BaseException:
        connection.close()
        raise
    return connection


def _in_database(path: Path, stack: contextlib.ExitStack) -> list[Found]:
    """Return the studies of a database file, which stays open until `stack` is closed.

    Raises:
        CheckpointError: The file is damaged, or was written by a newer version of kerv.
    """
    engine = sa.create_engine(
        "sqlite://", creator=lambda: connect_foreign(path, check_same_thread=False), poolclass=sa.pool.NullPool
    )
    with _damage(path):
        connection = stack.enter_context(engine.connect())
        about = tables.ABOUT.c
        version = int(connection.scalar(sa.select(about.value).where(about.key == "schema_version")) or 0)
        if version > SCHEMA:
            raise newer(path, version)
        found = [_stored(connection, row) for row in connection.execute(sa.select(tables.STUDIES)).all()]
    return [dataclasses.replace(one, episodes=_checked(path, one.episodes)) for one in found]


def _stored(connection: sa.Connection, row: Any) -> Found:
    """Return the study that a row of the table `studies` describes."""
    study, settings = stored_study(connection, row)
    runs = tables.RUNS.c
    newest = sa.select(runs.command).where(runs.kind == study.kind, runs.name == study.name)
    command = connection.scalar(newest.order_by(runs.started.desc(), runs.id.desc()).limit(1))
    return Found(study, _stored_episodes(connection, settings), tuple(command or ()))


def _stored_episodes(connection: sa.Connection, settings: dict[int, Setting]) -> Iterator[ImportedEpisode]:
    """Yield the stored episodes of some settings.

    Args:
        connection: The database.
        settings: The settings by their id in this database.

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


def _checked(path: Path, episodes: Iterator[ImportedEpisode]) -> Iterator[ImportedEpisode]:
    with _damage(path):
        yield from episodes


@contextlib.contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        why = " ".join(str(getattr(error, "orig", error)).split())[:160]
        raise CheckpointError(f"{path} is damaged, too large, or not a kerv.db: {why}") from error


def export_database(store: StudyStore, folder: Path) -> Path:
    """Write a kerv.db with a single study into a folder, and return the file. An existing kerv.db is replaced.

    Raises:
        UsageError: The folder contains other files.
        StorageError: The disk is full or not writable.
    """

    def fill(new: Path) -> None:
        copy = Database(new, file_url(new))
        with store.database.reading() as connection:
            row = connection.execute(sa.select(tables.STUDIES).where(tables.STUDIES.c.name == store.name)).one()
            found = _stored(connection, row)
            StudyStore(copy, store.name, store.kind).add(found.study, found.episodes, found.command)
        copy.close()

    if folder.is_dir() and any(path.name != FILE for path in folder.iterdir()):
        raise UsageError(f"{folder} holds other files: choose another folder with --dir")
    write_folder(folder, fill)
    return folder / FILE
