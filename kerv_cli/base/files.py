"""Write files and folders atomically (complete or not at all); read text, JSON and YAML; compute hashes.

Files and folders have a temporary name until they are complete: `.<name>.<16 hex digits>.tmp`.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import functools
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, StorageError, UsageError

# A temporary path that nothing has changed for so long was left by a process that was killed.
LEFT_OVER_SECONDS = 24 * 3600.0

_OF_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM)


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn an OSError inside the block into a StorageError, if the disk is full, broken or cannot be written."""
    try:
        yield
    except OSError as error:
        if error.errno not in _OF_DISK:
            raise
        raise StorageError(f"cannot write {path}: {error.strerror}") from error


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    temporary = temporary_beside(path)
    try:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _clean_once(path.parent)
            yield temporary
            sync(path.parent)
    finally:
        remove(temporary)


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path, and rename it to `path` at the end of the `with` block.

    Readers see the old file or the complete new one. The parent folder is created. If the block raises an exception,
    the temporary file is removed, and `path` keeps its old content.
    """
    with _temporary(path) as temporary:
        temporary.touch(exist_ok=False)
        yield temporary
        sync(temporary)
        os.replace(temporary, path)


def write_folder(folder: Path, fill: Callable[[Path], object]) -> None:
    """Write a folder atomically: `fill` a temporary folder, then rename it. An existing folder is replaced.

    If `fill` raises an exception, `folder` stays as it was.
    """
    with _temporary(folder) as temporary:
        temporary.mkdir()
        fill(temporary)
        for path in (*temporary.rglob("*"), temporary):
            sync(path)
        if folder.exists():
            _exchange(temporary, folder)
        else:
            os.rename(temporary, folder)


def set_aside(folder: Path) -> Path:
    """Rename a folder in one step, so that every command ignores it. Return the new path, which the caller deletes."""
    temporary = temporary_beside(folder)
    if folder.exists():
        with storage_errors(folder):
            folder.rename(temporary)
            sync(folder.parent)
    return temporary


def _exchange(a: Path, b: Path) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "renameat2"):
        here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
        if libc.renameat2(here, os.fsencode(a), here, os.fsencode(b), exchange) == 0:
            return
    old = temporary_beside(b)
    os.rename(b, old)
    os.rename(a, b)
    remove(old)


@contextlib.contextmanager
def owned(path: Path, check: Callable[[], object]) -> Iterator[None]:
    """Hold a lock while the block makes `path`, so that no other command does. `check` runs under the lock."""
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.with_name(f".{path.name}.lock").open("a")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"another command is making {path}: wait for it, or choose another name") from None
        check()
        yield


def unfinished(folder: Path) -> Path:
    """Return the hidden path beside `folder` where a training is kept until it is complete and replaces `folder`."""
    folder = folder.resolve()  # a link to a folder on another disk stays one
    return folder.with_name(f".{folder.name}.new")


def link_files(folder: Path, new: Path) -> None:
    def link(source: str, name: str) -> None:
        try:
            os.link(source, name)
        except OSError:
            shutil.copy2(source, name)

    temporary = shutil.ignore_patterns(".*.tmp")
    shutil.copytree(folder, new, symlinks=True, ignore=temporary, copy_function=link, dirs_exist_ok=True)


def own_folder() -> Path:
    """Return a temporary folder of this user that no other user can write, so that code in it may be trusted."""
    folder = Path(tempfile.gettempdir(), f"kerv-{os.getuid()}")
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022:
        return folder
    return Path(tempfile.mkdtemp(prefix="kerv-"))


def visible(folder: Path) -> list[Path]:
    """Return the paths in a folder in alphabetical order, without hidden ones. Empty if there is no folder."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return []


def sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: Path, content: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_if_changed(path: Path, content: bytes) -> None:
    """Write a file unless it has this content, so that its modification time says when the content changed."""
    if not path.is_file() or path.read_bytes() != content:
        write_bytes(path, content)


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically. NaN and infinity, which JSON cannot express, are a ValueError."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} is missing") from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read as JSON: {error}") from error


def read_mapping(path: Path) -> dict[str, Any]:
    value = read_json(path)
    if not isinstance(value, dict):
        raise CheckpointError(f"{path} cannot be read as JSON: it holds no object")
    return value


def read_yaml_lines(path: Path, what: str) -> tuple[dict[str, Any], dict[str, int]]:
    """Read the mapping in a YAML file. Return the mapping, and the line number of each key, such as `threshold.r`.

    `what` names the file in errors.
    """
    import yaml

    lines: dict[str, int] = {}

    def note(node: yaml.Node | None, prefix: str) -> None:
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
        loader = yaml.SafeLoader(path.read_text(encoding="utf-8"))
        node = loader.get_single_node()
        note(node, "")
        value = loader.construct_document(node) if node else {}
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{what} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)  # a character that no YAML file may have, such as NUL, has none
        why = getattr(error, "problem", None) or " ".join(str(error).split())
        raise UsageError(f"{path}{f':{mark.line + 1}' if mark else ''}: it is not YAML, {why}") from error
    if not isinstance(value, dict):
        raise UsageError(f"{what} holds no keys: write key: value")
    return value, lines


def sha256_of(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file. The result is cached until the file changes."""
    try:
        status = os.stat(path)
        return _sha256(str(path), status.st_ino, status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror}") from error


@functools.lru_cache(maxsize=4096)
def _sha256(path: str, inode: int, size: int, changed: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


_TEMPORARY = re.compile(r"\..+\.([0-9a-f]{16}|[^/]+\.\d+-[0-9a-f]{8})\.tmp")  # the second form: before 2026-11-29


def temporary_beside(path: Path) -> Path:
    name = path.name.encode()[:150].decode(errors="ignore")
    return path.with_name(f".{name}.{secrets.token_hex(8)}.tmp")


def clean(folder: Path) -> None:
    for path in folder.glob(".*.tmp"):
        if not _TEMPORARY.fullmatch(path.name):  # of another program
            continue
        with contextlib.suppress(OSError):  # it was renamed or removed meanwhile
            if time.time() - path.lstat().st_ctime > LEFT_OVER_SECONDS:
                remove(path)


# `clean`, once per folder and process. Later calls with the same folder do nothing.
_clean_once = functools.cache(clean)


def remove(path: Path) -> None:
    """Remove a file, or a folder with its content. A failure raises no error, because a later command tries again."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
