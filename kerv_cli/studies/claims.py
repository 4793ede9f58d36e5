"""Sweeps that share a study: who computes a cell claims it first, so that no two compute the same.

claims/<cell id>.json     who computes the cell: run, block, host, pid, started
claims/<block>.running    id of the block's cell that runs now; its age is the time since that episode began
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from kerv_cli.errors import StorageError
from kerv_cli.files import storage_errors, write_json
from kerv_cli.studies.plan import Cell

EXPIRES_HOURS = 6.0
"""A claim under which no episode began for so long is void: another machine cannot be asked whether a process lives."""


@dataclass(frozen=True)
class Claim:
    """run: of the sweep. block: of this run of a block, the same in all its claims."""

    run: str
    block: str
    host: str
    pid: int
    started: str


def claim(folder: Path, cells: Sequence[Cell], run: str, block: str) -> bool:
    """Claims all cells for this process, or none where one of them is somebody else's.

    Raises:
        StorageError: the disk refused.
    """
    mine = Claim(run, block, socket.gethostname(), os.getpid(), datetime.now(UTC).isoformat(timespec="seconds"))
    with write_lock(folder):
        if any(is_claimed(folder, cell) for cell in cells):
            return False
        for cell in cells:
            write_json(folder / f"{cell.id}.json", asdict(mine))
    return True


def is_claimed(folder: Path, cell: Cell) -> bool:
    """Whether a process that may still live computes the cell."""
    path = folder / f"{cell.id}.json"
    found = _read(path)
    if found is None:
        return False
    young = max(_changed(path), _changed(folder / f"{found.block}.running")) > time.time() - 3600 * EXPIRES_HOURS
    return young and (found.host != socket.gethostname() or is_alive(found.pid))


def note_running(folder: Path, cell: Cell, block: str) -> None:
    """Notes which cell of a block runs now: what kills this process fails that one."""
    path = folder / f"{block}.running"
    temporary = path.with_suffix(".next")
    with storage_errors(path):
        temporary.write_text(cell.id, encoding="utf-8")
        os.replace(temporary, path)


def running_cell(folder: Path, cells: Sequence[Cell], block: str) -> Cell | None:
    """The cell that this run of the block noted last."""
    try:
        name = (folder / f"{block}.running").read_text(encoding="utf-8")
    except OSError:
        return None
    return next((cell for cell in cells if cell.id == name), None)


def release(folder: Path, cells: Sequence[Cell], block: str) -> None:
    """Removes what this run of a block claimed and noted."""
    for path in (folder / f"{cell.id}.json" for cell in cells):
        found = _read(path)
        if found is not None and found.block == block:
            path.unlink(missing_ok=True)
    (folder / f"{block}.running").unlink(missing_ok=True)


def _read(path: Path) -> Claim | None:
    try:
        return Claim(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):  # none, or none of ours: no claim
        return None


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def is_alive(pid: int) -> bool:
    """Whether a process of this machine has that number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


@contextlib.contextmanager
def write_lock(path: Path) -> Iterator[None]:
    """One writer at a time changes `path`; readers need no lock. The lock file beside it stays empty, and a link in
    its place is refused instead of followed.

    Raises:
        StorageError: the disk refused, or the lock is a link.
    """
    import fcntl

    lock = path.with_name(f".{path.name}.lock")
    try:
        with storage_errors(lock):
            lock.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise StorageError(f"{lock} is a link, which kerv does not write through: remove it") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
