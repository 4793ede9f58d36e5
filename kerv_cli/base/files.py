"""Write files and folders atomically (complete or not at all); read text, JSON and YAML; compute hashes."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import hashlib
import itertools
import json
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, StorageError, UsageError
from kerv_cli.base.leftovers import clean, remove, temporary_beside

MOST_TEXT = 2**28
"""Maximum size of a JSON file in bytes. kerv's own files are far smaller."""
MOST_YAML = 2**18
"""Maximum size of a YAML file in bytes. Reading one takes ten seconds per megabyte."""
MOST_VALUES = 20_000
"""Maximum number of keys and values in a YAML file, with the ones that its aliases repeat."""
MOST_BYTES = 2**36
"""Maximum size of a file of weights or of a table in bytes."""

_OF_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM)


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn an OSError inside the `with` block into a StorageError, if the disk is full, broken or cannot be written.

    Args:
        path: The file or folder that is written, for the error message.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _OF_DISK:
            raise
        raise StorageError(f"cannot write {path}: {error.strerror}") from error


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path, and rename it to `path` at the end of the `with` block.

    Readers see the old file or the complete new one. The parent folder is created. If the block raises an exception,
    the temporary file is removed, and `path` keeps its old content.

    Raises:
        StorageError: The disk is full or read-only, or permission is missing.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _clean_once(path.parent)
            candidate = temporary_beside(path)
            candidate.touch(exist_ok=False)
            temporary = candidate
            yield temporary
            sync(temporary)
            os.replace(temporary, path)
            temporary = None
            sync(path.parent)
    finally:
        if temporary is not None:
            remove(temporary)


def write_folder(folder: Path, fill: Callable[[Path], object]) -> None:
    """Write a folder atomically: fill a temporary folder, then rename it. An existing folder is replaced.

    If `fill` raises an exception, `folder` stays as it was.

    Args:
        folder: Path of the finished folder.
        fill: Function that takes the temporary folder, and writes the content into it.

    Raises:
        StorageError: The disk is full or read-only, or permission is missing.
    """
    temporary = temporary_beside(folder)
    try:
        with storage_errors(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            _clean_once(folder.parent)
            temporary.mkdir()
            fill(temporary)
            for path in (*temporary.rglob("*"), temporary):
                sync(path)
            if folder.exists():
                _exchange(temporary, folder)
            else:
                os.rename(temporary, folder)
            sync(folder.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _exchange(a: Path, b: Path) -> None:
    """Replace folder `b` by folder `a`: in one step if the file system can, else `b` is removed first."""
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "renameat2"):
        here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
        if libc.renameat2(here, os.fsencode(a), here, os.fsencode(b), exchange) == 0:
            return
    shutil.rmtree(b)
    os.rename(a, b)


def visible(folder: Path) -> list[Path]:
    """Return the paths in a folder in alphabetical order, without hidden ones. Empty if the folder does not exist."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return []


@functools.cache
def _clean_once(folder: Path) -> None:
    """Remove temporary files of killed processes from a folder. Later calls of this process do nothing."""
    clean(folder)


def sync(path: Path) -> None:
    """Wait until the disk has stored a file, or a folder's list of names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically.

    Raises:
        StorageError: The disk is full or read-only, or permission is missing.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_if_changed(path: Path, content: bytes) -> None:
    """Write a file atomically, unless it has this content already. So its modification time says when it changed.

    Raises:
        StorageError: The disk is full or read-only, or permission is missing.
    """
    if not path.is_file() or path.read_bytes() != content:
        write_bytes(path, content)


def write_text(path: Path, text: str) -> None:
    """Write text in UTF-8 atomically; raises as `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON atomically; raises as `write_bytes`.

    Raises:
        ValueError: The value contains NaN or infinity, which JSON cannot express.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def regular(path: Path, most: int = MOST_BYTES) -> Path:
    """Return the path if it is a regular file of limited size. Use this before reading files of unknown origin.

    Args:
        path: The file.
        most: Maximum size in bytes.

    Raises:
        OSError: The file is missing, or it is a folder, a pipe or a device. Reading a pipe could wait forever.
        ValueError: The file is larger than `most`.
    """
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    if status.st_size > most:
        raise ValueError(f"{path} has {status.st_size} bytes, more than the {most} that kerv reads")
    return Path(path)


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """Return the text of a file.

    Args:
        path: The file.
        most: Maximum size in bytes.

    Raises:
        OSError: The file is missing or not a regular file.
        ValueError: The file is larger than `most` bytes, or not UTF-8.
    """
    return regular(path, most).read_text(encoding="utf-8")


def read_json(path: Path) -> Any:
    """Return the value in a JSON file.

    Raises:
        CheckpointError: The file is missing, not a regular file, too large, or not JSON.
    """
    try:
        return json.loads(read_text(path))
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} is missing") from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read as JSON: {error}") from error


def read_mapping(path: Path) -> dict[str, Any]:
    """Return the JSON object (a mapping) in a file; raises as `read_json`.

    Raises:
        CheckpointError: The JSON value is not an object.
    """
    value = read_json(path)
    if not isinstance(value, dict):
        raise CheckpointError(f"{path} cannot be read as JSON: it holds no object")
    return value


def read_yaml_lines(path: Path, what: str) -> tuple[dict[str, Any], dict[str, int]]:
    """Read a YAML file that contains a mapping, and note the line of each key for error messages.

    Args:
        path: The file.
        what: Name of the file in error messages.

    Returns:
        The mapping, and the line number of each key. Nested keys are joined by dots, such as `threshold.r`.

    Raises:
        UsageError: The file cannot be read, contains no mapping, gives a key twice, or is too large.
    """
    import yaml

    lines: dict[str, int] = {}
    noted = itertools.count(1)

    def note(node: yaml.Node | None, prefix: str) -> None:
        if next(noted) > MOST_VALUES:
            raise UsageError(f"{path}: its aliases expand it to more than {MOST_VALUES} values: write fewer")
        if isinstance(node, yaml.SequenceNode):
            for index, child in enumerate(node.value):
                note(child, f"{prefix}{index}.")
        elif isinstance(node, yaml.MappingNode):
            for key, child in node.value:
                name, line = f"{prefix}{key.value}", key.start_mark.line + 1
                if name in lines:
                    raise UsageError(f"{path}:{line}: {name} is given twice, also in line {lines[name]}")
                lines[name] = line
                note(child, f"{name}.")

    try:
        loader = yaml.SafeLoader(read_text(path, MOST_YAML))
        node = loader.get_single_node()
        note(node, "")
        value = loader.construct_document(node) if node else {}
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{what} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise UsageError(f"{path}:{line}: it is not YAML, {error.problem}") from error
    except yaml.YAMLError as error:  # a character that no YAML file may have, such as NUL
        raise UsageError(f"{path}: it is not YAML, {' '.join(str(error).split())}") from error
    if not isinstance(value, dict):
        raise UsageError(f"{what} holds no keys: write key: value")
    return value, lines


def sha256_of(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file. The result is cached until the file changes.

    Raises:
        CheckpointError: The file is missing or cannot be read.
    """
    try:
        status = os.stat(path)
        return _sha256(str(path), status.st_ino, status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror}") from error


@functools.lru_cache(maxsize=4096)
def _sha256(path: str, inode: int, size: int, changed: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
