"""Imports results folders of this version, and of version 0.1.0.

Version 0.1.0 had no database. It had one folder per study, with plan.yaml, run.json and one folder per cell. A cell is
a setting on one task with a few seeds.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from kerv_cli.base.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.base.files import read_mapping, read_yaml, sha256_of, visible
from kerv_cli.base.limits import check_label
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import SETTINGS_GROUPS, part_of
from kerv_cli.catalogue.stored import Imported, check_one, import_database
from kerv_cli.episodes.identity import ENGINE
from kerv_cli.episodes.rows import DECODE_SCHEMA, EPISODE_SCHEMA
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import FILE, Database
from kerv_cli.lab.plan import Episode, Setting, Study, plain_settings
from kerv_cli.lab.store import ROLLOUT, SWEEP, ImportedEpisode, StudyStore
from kerv_cli.methods.settings import with_artifacts
from kerv_cli.worlds.demos.files import foreign_table

_FOLDERS = {"studies": SWEEP, "rollouts": ROLLOUT}
_ROW = (*EPISODE_SCHEMA.names, "order", "started", "worker_pid")
_RENAMED = {name: f"{name}_tuned" for name in ("spec_vla", "kerv", "heisd")} | {
    f"{name}_paper": name for name in ("spec_vla", "kerv", "heisd")
}
_NOT_OF_BLOCK = {"state", "episodes", "successes", "seconds", "wall_seconds", "timed", "started", "files", "sha256",
                 "run", "pid", "code"}  # fmt: skip
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, pa.ArrowException, KervError)

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
        except _DAMAGE as error:
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
        except _DAMAGE as error:
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
