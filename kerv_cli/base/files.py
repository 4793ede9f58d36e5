"""Atomic writes (a file or a folder is complete or absent), JSON and YAML, hashes."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, StorageError
from kerv_cli.base.leftovers import clean, temporary_beside

_REFUSALS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "operation not permitted",
}


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turns OSErrors of a full, read-only or protected disk into a StorageError that names `path`."""
    try:
        yield
    except OSError as error:
        reason = _REFUSALS.get(error.errno or 0)
        if reason is None:
            raise
        raise StorageError(f"cannot write {path}: {reason}") from error


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`; when the block ends well it is synced and renamed to `path`.

    A reader sees the old file or the new one, never a part. The parent folder is created. When the block raises,
    the temporary file is removed and `path` stays as it was.

    Raises:
        StorageError: the disk is full or read-only, or the folder may not be written to.
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
            sync(path.parent)
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_folder(folder: Path, fill: Callable[[Path], object], replace: bool = False) -> bool:
    """Writes a folder atomically: `fill` gets a temporary one, which is synced and renamed -> whether it is in place.

    replace: an older folder of that name is exchanged for the new one in one step; otherwise it stays and the new one
    is discarded. When `fill` raises, everything stays as it was.

    Raises:
        StorageError: as `atomic_path`.
    """
    temporary = temporary_beside(folder)
    try:
        with storage_errors(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            _clean_once(folder.parent)
            _put_back(folder)
            temporary.mkdir()
            fill(temporary)
            for path in (*temporary.iterdir(), temporary):
                sync(path)
            placed = _rename_once(temporary, folder)
            if not placed and replace:
                _exchange(temporary, folder)
            sync(folder.parent)
            return placed or replace
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _rename_once(temporary: Path, folder: Path) -> bool:
    """Renames a folder to `folder`; False if that exists already and is not empty."""
    try:
        os.rename(temporary, folder)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise
    return True


def _exchange(a: Path, b: Path) -> None:
    """Exchanges the names of two folders in one step; in two where the file system or the system cannot."""
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "renameat2"):
        here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
        if libc.renameat2(here, os.fsencode(a), here, os.fsencode(b), exchange) == 0:
            return
    aside = _aside(b)
    os.rename(b, aside)
    try:
        os.rename(a, b)
    except OSError:
        os.rename(aside, b)
        raise
    os.rename(aside, a)


def _aside(folder: Path) -> Path:
    """Where the older folder lies between the two renames; no temporary name, so that nothing removes it."""
    return folder.with_name(f".{folder.name}.older")


def _put_back(folder: Path) -> None:
    """Puts the older folder back where a process ended between the two renames."""
    if not folder.exists() and _aside(folder).is_dir():
        os.rename(_aside(folder), folder)


def visible(folder: Path) -> list[Path]:
    """Paths in a folder, by name, without hidden ones: temporaries and locks are no results. Empty where there is no
    such folder."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return []


@functools.cache
def _clean_once(folder: Path) -> None:
    """Once per process and folder: a command that goes on removes what its killed predecessor left there."""
    clean(folder)


def sync(path: Path) -> None:
    """fsync of a file, or of a folder's entries."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: Path, value: Any) -> None:
    """Writes `value` as indented JSON, atomically; refuses NaN and infinity, which JSON lacks.

    Raises:
        StorageError: as in `atomic_path`. ValueError: NaN or infinity.
    """
    text = json.dumps(value, indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """The value in a JSON file.

    Raises:
        CheckpointError: the file is missing, unreadable, not JSON, or nested deeper than kerv's own files are.
    """
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
        check_shape(value)
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} is missing") from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read as JSON: {error}") from error
    return value


def read_yaml(text: str) -> Any:
    """The plain values in a YAML text.

    Raises:
        ValueError: it is not YAML, nested too deep, or its aliases stand for more values than a file of kerv's holds.
    """
    import yaml

    check_nesting(text)
    try:
        value = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"not YAML: {error}") from error
    check_shape(value)
    return value


def check_nesting(text: str, depth: int = 1000) -> None:
    """Refuses a YAML text that is nested so deep that a parser would run out of its stack.

    Raises:
        ValueError: more than `depth` open brackets, or a line that begins with more indentation than that.
    """
    opened = 0
    for bracket in re.findall(r"[\[\]{}]", text) if text.count("[") + text.count("{") > depth else ():
        opened = opened + 1 if bracket in "[{" else max(0, opened - 1)
        if opened > depth:
            raise ValueError(f"nested more than {depth} deep")
    if re.search(rf"^[ \t?:-]{{{depth}}}", text, re.MULTILINE):
        raise ValueError(f"nested more than {depth} deep")


def to_yaml(value: Any, **options: Any) -> str:
    """Plain values as YAML."""
    import yaml

    text: str = yaml.dump(value, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), sort_keys=False, **options)
    return text


def check_shape(value: Any, depth: int = 64, most: int = 5_000_000) -> None:
    """Refuses values that later code would follow without end.

    Raises:
        ValueError: containers more than `depth` deep, or more than `most` values with every alias followed.
    """
    # every container once, with how often it occurs on its level: aliases may repeat one beyond all bounds
    level, count = {id(v): (v, 1) for v in [value] if isinstance(v, dict | list)}, 0
    for _ in range(depth):
        if not level:
            return
        count += sum(times * len(found) for found, times in level.values())
        if count > most:
            raise ValueError(f"it holds more than {most} values")
        below: dict[int, tuple[Any, int]] = {}
        for found, times in level.values():
            for inner in found.values() if isinstance(found, dict) else found:
                if isinstance(inner, dict | list):
                    below[id(inner)] = inner, times + below.get(id(inner), (inner, 0))[1]
        level = below
    raise ValueError(f"it is nested more than {depth} deep")


def sha256_of(path: Path) -> str:
    """Hex SHA-256 of a file's bytes; read once per process as long as inode, size and time of change stay the same.

    Raises:
        CheckpointError: the file is missing or unreadable.
    """
    try:
        stat = os.stat(path)
        return _sha256(str(path), stat.st_ino, stat.st_size, stat.st_mtime_ns)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror}") from error


@functools.lru_cache(maxsize=4096)
def _sha256(path: str, inode: int, size: int, changed: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
