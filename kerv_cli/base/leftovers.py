"""The hidden names that kerv writes, all of them: no catalogue lists a name that begins with a dot.

.<name>.<host>.<process>-<8 digits>.tmp   a file or a folder that is being written, or removed; its process is named, so
                                          that what a dead one left can be removed
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
"""Age from which a temporary of another machine is taken for one of a dead process, which cannot be known from here."""

_NAME = re.compile(r"\..+\.(?P<host>[^/]+?)\.(?P<pid>\d+)-[0-9a-f]{8}\.tmp")


def temporary_beside(path: Path) -> Path:
    """A new hidden name in the folder of `path` that names this machine and process: `.<name>.<host>.<pid>-<8>.tmp`."""
    mark = f"{socket.gethostname().replace('.', '-')}.{os.getpid()}-{secrets.token_hex(4)}"
    return path.with_name(f".{path.name[:150]}.{mark}.tmp")


def is_left_over(path: Path) -> bool:
    """Whether `path` is a temporary file or folder whose process has ended."""
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
    """Paths that dead processes left anywhere below `root`; links are not followed."""
    for folder, folders, files in os.walk(root):
        paths = [Path(folder, name) for name in (*folders, *files) if is_left_over(Path(folder, name))]
        folders[:] = [name for name in folders if Path(folder, name) not in paths]
        yield from sorted(paths)


def clean(folder: Path) -> list[Path]:
    """Removes the files and folders that dead processes left in `folder` itself -> their paths."""
    paths = [path for path in folder.glob(".*.tmp") if is_left_over(path)]
    for path in paths:
        remove(path)
    return sorted(paths)


def remove(path: Path) -> None:
    """Removes a file or a folder; what cannot be removed stays."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def is_alive(pid: int) -> bool:
    """Whether a process of this machine has that number."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
