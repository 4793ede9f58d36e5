"""Recognises what `kerv runs import PATH` is given, and imports it."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Sequence
from pathlib import Path

from kerv_cli.base.errors import UsageError
from kerv_cli.base.foreign import foreign_sqlite
from kerv_cli.catalogue import lerobot, vla_eval
from kerv_cli.catalogue.older import import_older, is_older
from kerv_cli.catalogue.stored import import_database
from kerv_cli.lab.database import ABOUT, FILE, Database


def is_results(path: Path) -> bool:
    """Return whether a path is a results folder or a kerv.db.

    Raises:
        UsageError: Nothing is there.
    """
    if not path.exists():
        raise UsageError(
            f"{path} does not exist: name a results folder, a kerv.db, or evaluations of vla-eval or lerobot"
        )
    return _database_of(path) is not None or (path.is_dir() and is_older(path))


def _database_of(path: Path) -> Path | None:
    """Return the kerv.db that a path is or holds."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file() or file.suffix == ".json":
        return None
    if file.name == FILE:
        return file
    with contextlib.suppress(sqlite3.Error, OSError, ValueError), foreign_sqlite(file) as connection:
        query = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?"
        return file if connection.execute(query, (ABOUT.name,)).fetchone() else None
    return None


def import_results(results: Database, paths: Sequence[Path], name: str = "") -> tuple[list[str], list[str]]:
    """Copy the studies of results folders and databases -> (their names, lines about what is left out).

    Raises:
        UsageError: The results folder itself, or a name for several. CheckpointError: A database is damaged.
    """
    names: list[str] = []
    notes: list[str] = []
    for path in paths:
        found = []
        if path.is_dir() and is_older(path):
            found.append(import_older(results, path, name))
        file = _database_of(path)
        if file is not None and not (
            results.file is not None and results.file.exists() and file.samefile(results.file)
        ):
            found.append(import_database(results, file, name))
        elif file is not None and not found:
            raise UsageError(f"{path} is the results folder that it would be imported into: name another with results=")
        for studies, lines in found:
            names += studies
            notes += lines
    return names, notes


def import_evaluations(
    results: Path, paths: Sequence[Path], name: str, labels: Sequence[str], baseline: str, words: Sequence[str]
) -> tuple[str, list[str]]:
    """Write evaluations of vla-eval and lerobot as one study -> (its name, lines about what is missing).

    Raises:
        UsageError: A path holds no evaluation, or they cannot be compared. CheckpointError: A file is damaged.
    """
    sides = vla_eval.sides_of([_evaluations(path) for path in paths], labels)
    name = name or vla_eval.study_name(sides)
    return name, vla_eval.write_study(results, name, sides, baseline, words)


def _evaluations(path: Path) -> list[vla_eval.Evaluation]:
    info = path / lerobot.FILE if path.is_dir() else path
    if info.name == lerobot.FILE and info.is_file():
        return lerobot.read_info(info)
    return vla_eval.read_evaluations(path)
