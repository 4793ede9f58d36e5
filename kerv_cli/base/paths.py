"""Paths in the results folder (docs/formats.md)."""

from __future__ import annotations

import tempfile
from pathlib import Path

from kerv_cli.base.errors import StorageError, UsageError
from kerv_cli.base.files import storage_errors
from kerv_cli.base.limits import check_name


def results_dir(results: str) -> Path:
    """Return the path of the results folder, which need not exist.

    Raises:
        UsageError: The path is a file, or no file system accepts it.
    """
    path = as_path(results)
    if path.exists() and not path.is_dir():
        raise UsageError(f"results={results} is a file: name a folder")
    return path


def check_writable(results: str) -> Path:
    """Check that the results folder can be written, before anything is computed. Nothing is created.

    Returns:
        The results folder if it exists, else the nearest existing folder above it.

    Raises:
        UsageError: The path is a file, or below a file.
        StorageError: The disk is full or read-only, or permission is missing.
    """
    folder = results_dir(results)
    parent = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not parent.is_dir():
        raise UsageError(f"results={results}: {parent} is a file, name a folder")
    try:
        # an unnamed file, if the file system supports that: nothing is left if the process is killed here
        with storage_errors(folder), tempfile.TemporaryFile(dir=parent):
            pass
    except OSError as error:
        raise StorageError(f"cannot write {folder}: {error.strerror}") from error
    return parent


def artifact(results: str, kind: str, name: str) -> Path:
    """Return the folder of an artifact in the results folder: <results>/artifacts/<kind>/<name>.

    Commands write artifacts only to such folders. To read one that may be elsewhere, use `artifact_or_path`.

    Raises:
        UsageError: `name` cannot be the name of a folder, for example because it contains a slash.
    """
    return results_dir(results) / "artifacts" / kind / check_name(name, f"{kind} name")


def artifact_or_path(results: str, kind: str, name: str) -> Path:
    """Return the folder of an artifact to read: `artifact`, or the path `name` if it contains a slash.

    Raises:
        UsageError: `name` can be neither a folder's name nor a path.
    """
    return as_path(name) if "/" in name else artifact(results, kind, name)


def as_path(text: str) -> Path:
    """Return a path that the user typed. `~` becomes the home folder.

    Raises:
        UsageError: No file system accepts such a path.
    """
    if "\0" in text or any(len(part.encode()) > 255 for part in text.split("/")) or len(text) > 4000:
        raise UsageError(f"'{text[:80]}…' is no path")
    return Path(text).expanduser()
