"""Claims on cells: sweeps that share a study claim a cell before they compute it, so that no two compute the same.

claims/<cell id>.json     the process that computes the cell: run, block, host, pid, started
claims/<block>.running    id of the block's cell that runs now and the number of episodes that have ended; its age is
                          the time since this episode began
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json, read_text, storage_errors, write_json
from kerv_cli.base.leftovers import is_alive, lock_beside, temporary_beside
from kerv_cli.base.manifests import read
from kerv_cli.lab.plan import Cell

EXPIRES_HOURS = 6.0
"""A claim is void when no episode began under it for so long: whether a process of another machine lives is unknown."""


@dataclass(frozen=True)
class Claim:
    """The process that computes a cell. run: id of the sweep. block: name of this attempt at a block, the same in all
    its claims."""

    run: str
    block: str
    host: str
    pid: int
    started: str


def claim(folder: Path, cells: Sequence[Cell], run: str, block: str) -> bool:
    """Claims all cells for this process -> True; claims none where another process has one of them -> False.

    Raises:
        StorageError: the disk refused.
    """
    holder = Claim(run, block, socket.gethostname(), os.getpid(), datetime.now(UTC).isoformat(timespec="seconds"))
    with write_lock(folder):
        if any(is_claimed(folder, cell) for cell in cells):
            return False
        for cell in cells:
            write_json(folder / f"{cell.id}.json", asdict(holder))
    return True


def is_claimed(folder: Path, cell: Cell) -> bool:
    """Whether a process that may still live computes the cell."""
    return _is_held(folder / f"{cell.id}.json")


def void(folder: Path) -> list[Path]:
    """The claims whose process has ended or whose time is up, and the notes that belong to no claim."""
    claims = sorted(folder.glob("[!.]*.json"))
    held = {path for path in claims if _is_held(path)}
    blocks = {holder.block for path in held if (holder := _read(path)) is not None}
    notes = [path for path in sorted(folder.glob("[!.]*.running")) if path.stem not in blocks]
    return [path for path in claims if path not in held] + notes


def clean_void(folder: Path) -> None:
    """Removes void claims and notes, e.g. of a sweep that was killed."""
    if folder.is_dir():
        with write_lock(folder):
            for path in void(folder):
                path.unlink(missing_ok=True)


def _is_held(path: Path) -> bool:
    folder, holder = path.parent, _read(path)
    if holder is None:
        return False
    young = max(_changed(path), _changed(folder / f"{holder.block}.running")) > time.time() - 3600 * EXPIRES_HOURS
    return young and (holder.host != socket.gethostname() or is_alive(holder.pid))


def note_running(folder: Path, cell: Cell, block: str, ended: int = 0) -> None:
    """Notes which cell of a block runs now: if this process is killed, that cell has failed. ended: episodes of the
    block so far."""
    path = folder / f"{block}.running"
    temporary = temporary_beside(path)
    with storage_errors(path):
        temporary.write_text(f"{cell.id} {ended}", encoding="utf-8")
        os.replace(temporary, path)


def running_cell(folder: Path, cells: Sequence[Cell], block: str) -> Cell | None:
    """The cell that this attempt at the block noted last; None before its first episode."""
    name, _ = _running(folder, block)
    return next((cell for cell in cells if cell.id == name), None)


def episodes_ended(folder: Path, block: str) -> int:
    """Episodes of this attempt at a block that have ended, as far as it has noted them."""
    return _running(folder, block)[1]


def _running(folder: Path, block: str) -> tuple[str, int]:
    try:
        name, ended = read_text(folder / f"{block}.running").split()
        return name, int(ended)
    except (OSError, ValueError):
        return "", 0


def release(folder: Path, cells: Sequence[Cell], block: str) -> None:
    """Removes the claims and the note of this attempt at a block."""
    for path in (folder / f"{cell.id}.json" for cell in cells):
        holder = _read(path)
        if holder is not None and holder.block == block:
            path.unlink(missing_ok=True)
    (folder / f"{block}.running").unlink(missing_ok=True)


def _read(path: Path) -> Claim | None:
    try:
        return read(Claim, read_json(path), "a claim")
    except CheckpointError:  # missing, or not a claim
        return None


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


@contextlib.contextmanager
def write_lock(path: Path) -> Iterator[None]:
    """Lets one process at a time change `path`; readers need no lock. The lock is an empty file beside `path`, which is
    there as long as it is held.

    Raises:
        StorageError: the disk refused.
    """
    import fcntl

    lock = lock_beside(path)
    while True:
        with storage_errors(lock):
            lock.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            if not _is_at(descriptor, lock):  # who held it before has removed it
                continue
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
            return
        finally:
            os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one at `path`."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
