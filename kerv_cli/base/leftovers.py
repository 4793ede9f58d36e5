"""Names of files and folders that are being written, and their removal after their process has died.

Such a name is hidden and names its process: `.<name>.<host>.<process>-<8 digits>.tmp`.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path

OTHER_HOSTS_STALE_HOURS = 7 * 24.0
"""A temporary file of another machine is taken for a dead process's after this many hours."""

_NAME = re.compile(r"\..+\.(?P<host>[^/]+?)\.(?P<pid>\d+)-[0-9a-f]{8}\.tmp")


def temporary_beside(path: Path) -> Path:
    """Return a new hidden name beside `path` that names this machine and process."""
    mark = f"{socket.gethostname().replace('.', '-')}.{os.getpid()}-{secrets.token_hex(4)}"
    return path.with_name(f".{path.name[:150]}.{mark}.tmp")


def is_left_over(path: Path) -> bool:
    """Return whether `path` is temporary and its process has ended."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        return False
    if match["host"] == socket.gethostname().replace(".", "-"):
        return not is_alive(int(match["pid"]))
    try:
        return time.time() - path.stat().st_mtime > 3600 * OTHER_HOSTS_STALE_HOURS
    except OSError:  # its owner was faster
        return False


def left_over(root: Path) -> Iterator[Path]:
    """Yield what dead processes left anywhere below `root`. Links are not followed."""
    for folder, folders, files in os.walk(root):
        paths = [Path(folder, name) for name in (*folders, *files) if is_left_over(Path(folder, name))]
        folders[:] = [name for name in folders if Path(folder, name) not in paths]
        yield from sorted(paths)


def clean(folder: Path) -> list[Path]:
    """Remove what dead processes left in `folder` itself, and return the paths."""
    paths = [path for path in folder.glob(".*.tmp") if is_left_over(path)]
    for path in paths:
        remove(path)
    return sorted(paths)


def remove(path: Path) -> None:
    """Remove a file or a folder. What cannot be removed stays."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def is_alive(pid: int) -> bool:
    """Return whether a process of this machine has that number."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
