"""Give temporary names to files and folders while they are written, and remove what killed processes left.

A temporary name is hidden and names the machine and the process: `.<name>.<host>.<process id>-<8 digits>.tmp`.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import socket
import time
from pathlib import Path

OTHER_HOSTS_STALE_HOURS = 7 * 24.0
"""After this many hours a temporary file of another machine counts as left over by a killed process."""

CLOCKS_DIFFER_SECONDS = 3600.0
"""The clock of a network folder may be behind this machine's clock by this many seconds."""

_NAME = re.compile(r"\..+\.(?P<host>[^/]+?)\.(?P<pid>\d+)-[0-9a-f]{8}\.tmp")


def temporary_beside(path: Path) -> Path:
    """Return a new temporary path in the same folder as `path`. Its name contains this machine and process."""
    mark = f"{socket.gethostname().replace('.', '-')}.{os.getpid()}-{secrets.token_hex(4)}"
    return path.with_name(f".{path.name[:150]}.{mark}.tmp")


def is_left_over(path: Path) -> bool:
    """Return whether `path` has a temporary name and the process that wrote it has ended.

    A file of another machine counts as left over once it is older than OTHER_HOSTS_STALE_HOURS.
    """
    match = _NAME.fullmatch(path.name)
    if match is None:
        return False
    try:
        written = path.stat().st_mtime
    except OSError:  # it was renamed or removed meanwhile
        return False
    if match["host"] == socket.gethostname().replace(".", "-"):
        return not is_alive(int(match["pid"]), written + CLOCKS_DIFFER_SECONDS)
    return time.time() - written > 3600 * OTHER_HOSTS_STALE_HOURS


def clean(folder: Path) -> list[Path]:
    """Remove the temporary files and folders of ended processes from `folder`, not from its subfolders.

    Returns:
        The paths that the function tried to remove. A path still exists if removing it failed.
    """
    paths = [path for path in folder.glob(".*.tmp") if is_left_over(path)]
    for path in paths:
        remove(path)
    return sorted(paths)


def remove(path: Path) -> None:
    """Remove a file, or a folder with its content. If this fails, a later command tries again, without an error."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def is_alive(pid: int, seen: float) -> bool:
    """Return whether a process of this machine that was alive at the time `seen` is still alive.

    A process that has the same id but began later does not count. Only Linux tells when a process began. On any other
    system every process with this id counts.

    Args:
        pid: Id of the process.
        seen: A time at which the process was alive, in seconds since 1970.
    """
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    try:
        ticks = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return True
    return time.time() - age <= seen + 1.0  # the kernel counts in ticks of about 0.01 s
