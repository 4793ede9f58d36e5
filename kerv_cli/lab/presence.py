"""Who lives: a row in the table `workers` per command and per worker, with a heartbeat, and a lock on a file.

Times are those of the database's own clock, because the clocks of two machines may differ. The operating system gives
the lock back when a process ends, however it ends, so a process of this machine that was killed is known at once.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import secrets
import socket
import threading
from pathlib import Path
from typing import Self

import sqlalchemy as sa

from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.base.files import storage_errors
from kerv_cli.lab.database import UNFINISHED, WANTED, WORKERS, Database, clock, roll_back

BEAT_SECONDS = 5.0
"""Seconds between two heartbeats."""
LAPSE_SECONDS = 30.0
"""Seconds without a heartbeat after which others may run what a worker has claimed."""
_FORGET_SECONDS = 86_400.0
_FOLDER = ".workers"


@functools.cache
def _machine() -> bytes:
    """Return what is the same for all processes of a kernel: two containers may have one host name."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_bytes().strip()
    return socket.gethostname().encode()


def _lock_of(database: Database, name: str) -> Path:
    return database.results / _FOLDER / f"{name}.lock"


def _lock(path: Path) -> int:
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        with contextlib.suppress(OSError):  # a file system without locks: others rely on the heartbeat
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.write(descriptor, _machine())
    return descriptor


def _was_killed(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:  # it is a process of another machine
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return os.read(descriptor, 100) == _machine()
    except OSError:
        return False
    finally:
        os.close(descriptor)


def beats(connection: sa.Connection) -> sa.ColumnElement[bool]:
    """Return the condition that a row of WORKERS had a heartbeat lately."""
    return WORKERS.c.heartbeat >= clock(connection) - LAPSE_SECONDS


def living(database: Database, connection: sa.Connection) -> dict[str, str]:
    """Return the name of each living command and worker, with the id of the command for which it works."""
    rows = connection.execute(sa.select(WORKERS.c.name, WORKERS.c.run).where(beats(connection)))
    return {name: run for name, run in rows if not _was_killed(_lock_of(database, name))}


def bury(database: Database) -> None:
    """Remove the rows of killed processes of this machine, so that others may run what these had claimed."""
    with database.reading() as connection:
        names = connection.scalars(sa.select(WORKERS.c.name)).all()
    dead = [name for name in names if _was_killed(_lock_of(database, name))]
    if dead:
        with database.writing() as connection:
            connection.execute(sa.delete(WORKERS).where(WORKERS.c.name.in_(dead)))
    for name in dead:
        _lock_of(database, name).unlink(missing_ok=True)


class Presence:
    """Tells others that this process lives, from the start to the end of a `with` statement.

    At the end, rows that it has claimed and not finished become free.

    Args:
        database: Where others look.
        run: Id of the command for which it works. If empty, any command.
    """

    def __init__(self, database: Database, run: str = "") -> None:
        self.database, self.run = database, run
        self.worker = f"{socket.gethostname()[:60]}-{secrets.token_hex(6)}"
        self._lock: int | None = None
        self._ended = threading.Event()
        self._heart = threading.Thread(target=self._keep_beating, daemon=True)

    def __enter__(self) -> Self:
        self._lock = _lock(_lock_of(self.database, self.worker))
        try:
            with self.database.writing() as connection:
                self._begin_in(connection)
        except BaseException:
            self._unlock()
            raise
        self._heart.start()
        return self

    def _begin_in(self, connection: sa.Connection) -> None:
        forgotten = WORKERS.c.heartbeat < clock(connection) - _FORGET_SECONDS
        connection.execute(sa.delete(WORKERS).where(forgotten))
        self.beat_in(connection)

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            _lock_of(self.database, self.worker).unlink(missing_ok=True)

    def beat_in(self, connection: sa.Connection) -> None:
        """Write a sign of life, in a transaction."""
        beaten = sa.update(WORKERS).where(WORKERS.c.name == self.worker).values(heartbeat=clock(connection))
        if not connection.execute(beaten).rowcount:
            row = {"name": self.worker, "run": self.run, "host": socket.gethostname()}
            connection.execute(sa.insert(WORKERS).values(**row, heartbeat=clock(connection)))

    def _keep_beating(self) -> None:
        while not self._ended.wait(BEAT_SECONDS):
            # the process itself will meet the same error and report it
            with contextlib.suppress(KervError), self.database.writing() as connection:
                self.beat_in(connection)

    def _stop(self) -> None:
        roll_back()  # otherwise the heart may wait for this thread's lock
        self._ended.set()
        if self._heart.is_alive():
            self._heart.join()

    def __exit__(self, *error: object) -> None:
        self._stop()
        mine = WANTED.c.worker == self.worker
        with contextlib.suppress(StorageError), self.database.writing() as connection:
            connection.execute(sa.update(WANTED).where(mine, UNFINISHED).values(worker=None, attempts=0))
            connection.execute(sa.delete(WORKERS).where(WORKERS.c.name == self.worker))
        self._unlock()
