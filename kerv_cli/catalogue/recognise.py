"""Recognises what `kerv runs import PATH` is given, and imports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kerv_cli.base.errors import UsageError
from kerv_cli.catalogue import lerobot, vla_eval
from kerv_cli.catalogue.older import import_older, older_studies
from kerv_cli.catalogue.stored import Imported, import_database
from kerv_cli.lab.database import FILE, Database


def is_results(path: Path) -> bool:
    """Return whether a path is a results folder or a kerv.db.

    Raises:
        UsageError: It does not exist.
    """
    if not path.exists():
        raise UsageError(
            f"{path} does not exist: name a results folder, a kerv.db, or evaluations of vla-eval or lerobot"
        )
    return _database_of(path) is not None or bool(older_studies(path))


def _database_of(path: Path) -> Path | None:
    """Return the database that a path is or holds. Its name ends with .db."""
    file = path / FILE if path.is_dir() else path
    return file if file.is_file() and file.suffix == Path(FILE).suffix else None


def import_results(results: Database, paths: Sequence[Path], name: str = "") -> Imported:
    """Copy the studies of results folders and databases.

    Args:
        results: Where they are copied to.
        paths: Results folders of this version or 0.1.0, and databases.
        name: Name of the study here, if there is only one. Empty: as there.

    Raises:
        UsageError: A path is the results folder itself, or `name` is set and there are several studies.
        CheckpointError: A database is damaged.
    """
    imported = Imported()
    for path in paths:
        older, file = older_studies(path), _database_of(path)
        if older:
            import_older(results, path, name, imported)
        is_same = (
            file is not None and results.file is not None and results.file.exists() and file.samefile(results.file)
        )
        if file is not None and not is_same:
            import_database(results, file, name, imported)
        elif is_same and not older:
            raise UsageError(f"{path} is the results folder that it would be imported into: name another with results=")
    return imported


def import_evaluations(
    results: Path, paths: Sequence[Path], name: str, labels: Sequence[str], baseline: str, words: Sequence[str]
) -> tuple[str, list[str]]:
    """Write evaluations of vla-eval and lerobot as one study.

    Args:
        results: The results folder.
        paths: Recordings, or folders that hold some.
        name: Name of the study. Empty: that of the benchmarks.
        labels: A label for each path. Empty: names of the servers.
        baseline: Label of the baseline. Empty: ar, else the first.
        words: Words after `kerv` of the command.

    Returns:
        The name of the study, and lines about missing episodes.

    Raises:
        UsageError: A path holds no evaluation, or they cannot be compared.
        CheckpointError: A file is damaged.
    """
    servers = vla_eval.by_server([_evaluations(path) for path in paths], labels)
    name = name or vla_eval.study_name(servers)
    return name, vla_eval.write_study(results, name, servers, baseline, words)


def _evaluations(path: Path) -> list[vla_eval.Evaluation]:
    info = path / lerobot.FILE if path.is_dir() else path
    if info.name == lerobot.FILE and info.is_file():
        return lerobot.read_info(info)
    return vla_eval.read_evaluations(path)
