"""The tables of commands that were started (runs), and of living commands and workers, each with a heartbeat.

Times are those of the database's own clock, because the clocks of two machines may differ. Each process also holds a
lock on a file. The operating system gives the lock back when the process ends, however it ends, so a process of this
machine that was killed is known at once.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import secrets
import socket
import threading
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sa

from kerv_cli.base.durations import left
from kerv_cli.base.errors import CheckpointError, Interrupted, KervError, StorageError, UsageError
from kerv_cli.base.files import storage_errors
from kerv_cli.lab.command import current_command
from kerv_cli.lab.database import (
    EPISODES,
    RUNS,
    STUDIES,
    UNFINISHED,
    WANTED,
    WORKERS,
    Database,
    clock,
    now,
    roll_back,
)
from kerv_cli.targets.provenance import git_commit

RUNNING, COMPLETE, FAILED, INTERRUPTED = "running", "complete", "failed", "interrupted"


BEAT_SECONDS = 5.0
"""Seconds between two heartbeats."""
LAPSE_SECONDS = 30.0
"""Seconds without a heartbeat after which other workers may run a worker's claimed episodes."""
_FORGET_SECONDS = 86_400.0
_FOLDER = ".workers"


@functools.cache
def _machine() -> bytes:
    """Return an id of this machine's running kernel. A host name would not do, because two containers can share one."""
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
    """Return the SQL condition that a row of WORKERS has a recent heartbeat."""
    return WORKERS.c.heartbeat >= clock(connection) - LAPSE_SECONDS


def living(database: Database, connection: sa.Connection) -> dict[str, str]:
    """Return the names of all living commands and workers, each with the id of the command for which it works."""
    rows = connection.execute(sa.select(WORKERS.c.name, WORKERS.c.run).where(beats(connection)))
    return {name: run for name, run in rows if not _was_killed(_lock_of(database, name))}


def bury(database: Database) -> None:
    """Remove the rows of killed processes of this machine, so that other workers may run their claimed episodes."""
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

    At the end, episodes that the process has claimed and not finished become free.

    Args:
        database: Database in which this process is listed.
        run: Id of the command for which the process works. If empty, any command.
    """

    def __init__(self, database: Database, run: str = "") -> None:
        self.database, self.run = database, run
        self.worker = f"{socket.gethostname()[:60]}-{secrets.token_hex(6)}"
        self._ended = threading.Event()
        self._heart = threading.Thread(target=self._keep_beating, daemon=True)

    def __enter__(self) -> Self:
        self._lock = _lock(_lock_of(self.database, self.worker))  # before others can read the name
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
        os.close(self._lock)
        _lock_of(self.database, self.worker).unlink(missing_ok=True)

    def beat_in(self, connection: sa.Connection) -> None:
        """Write a heartbeat, in the open transaction of `connection`."""
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


_SEEN = sa.select(sa.func.max(WORKERS.c.heartbeat)).where(WORKERS.c.run == RUNS.c.id).scalar_subquery()


def _rows(database: Database, connection: sa.Connection, *where: sa.ColumnElement[bool]) -> Sequence[Any]:
    is_dead = sa.and_(RUNS.c.status == RUNNING, RUNS.c.id.not_in(set(living(database, connection).values())))
    status = sa.case((is_dead, INTERRUPTED), else_=RUNS.c.status).label("status")
    columns = [column for column in RUNS.c if column is not RUNS.c.status]
    query = sa.select(*columns, status, _SEEN.label("seen")).where(*where)
    return connection.execute(query.order_by(RUNS.c.started.desc(), RUNS.c.id.desc())).all()


def run_rows(database: Database, kind: str = "", name: str = "") -> Sequence[Any]:
    """Return the rows of the commands that were started, newest first.

    A running command whose process is dead has the status `interrupted`. The column `seen` is a running command's
    newest heartbeat, in seconds since 1970.

    Args:
        database: The database.
        kind: Only runs of this kind; empty for all.
        name: Only runs that made this study or artifact; empty for all.
    """
    where = [RUNS.c[key] == value for key, value in {"kind": kind, "name": name}.items() if value]
    with database.reading() as connection:
        return _rows(database, connection, *where)


def time_left(row: Any) -> str:
    """Return the estimated remaining time of a running command, such as `about 3 min left`. Empty if unknown."""
    if row.status != RUNNING or not 0 < row.done < row.total:
        return ""
    return left(row.seen - datetime.fromisoformat(row.started).timestamp(), row.done, row.total)


def pulse(database: Database) -> tuple[str, bool]:
    """Return a short text that changes whenever the results folder changes, and whether a command is running.

    Returns:
        text: Changes with every heartbeat (sign of life), start or end of a command, and with every new episode.
        running: Whether a command is running.
    """
    studies = sa.select(sa.func.count()).select_from(STUDIES).scalar_subquery()
    newest = sa.select(sa.func.max(EPISODES.c.id)).scalar_subquery()
    beat = sa.select(sa.func.max(WORKERS.c.heartbeat)).scalar_subquery()
    facts = sa.select(sa.func.count(), beat, studies, newest).select_from(RUNS)
    with database.reading() as connection:
        rows = _rows(database, connection, RUNS.c.status == RUNNING)
        alive = [row.id for row in rows if row.status == RUNNING]
        return "/".join(map(str, [*connection.execute(facts).one(), *alive])), bool(alive)


class Run(Presence):
    """Writes the database row of a command, from its start to its end. Use it in a `with` statement.

    The row is deleted if the command ends with a UsageError. It is also deleted if the command made nothing because its
    input cannot be read (a CheckpointError).

    Args:
        database: Where the row is written.
        kind: sweep, rollout, or the kind of artifact (weights or data) that the command makes.
        name: Name of the study or artifact.
        command: Command-line arguments (without `kerv`) that resume the command. If empty, `current_command()`.
        total: Number of steps or episodes.
        alone: Whether to refuse to start while another process makes the same study or artifact.
    """

    def __init__(
        self,
        database: Database,
        kind: str,
        name: str,
        command: Sequence[str] = (),
        total: int = 0,
        alone: bool = True,
    ) -> None:
        self.id = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"
        super().__init__(database, self.id)
        self.kind, self.name, self.alone = kind, name, alone
        self.command = list(command) or current_command()
        self.total, self.done = total, 0

    def _begin_in(self, connection: sa.Connection) -> None:
        same = RUNS.c.kind == self.kind, RUNS.c.name == self.name, RUNS.c.status == RUNNING
        others = [row for row in _rows(self.database, connection, *same) if row.status == RUNNING]
        if self.alone and others:
            whose = f"on {others[0].host} since {others[0].started[:16]}"
            raise UsageError(f"{self.kind} {self.name} is being made {whose}: wait for it, or choose another name")
        dead = sa.update(RUNS).where(*same, RUNS.c.id.not_in([row.id for row in others]))
        connection.execute(dead.values(status=INTERRUPTED))
        connection.execute(
            sa.insert(RUNS).values(
                id=self.id, kind=self.kind, name=self.name, command=self.command, status=RUNNING, done=0,
                total=self.total, message="", host=socket.gethostname(), started=now(), git_commit=git_commit(),
            )
        )  # fmt: skip
        super()._begin_in(connection)

    def beat(self, done: int, total: int | None = None) -> None:
        """Store the progress, which the next heartbeat writes. If `total` changes, it is written at once.

        Args:
            done: Number of steps or episodes that are finished.
            total: Number of steps or episodes in all. If None, the total does not change.
        """
        is_new = total not in (None, self.total)
        self.done, self.total = done, self.total if total is None else total
        if is_new:
            with self.database.writing() as connection:
                self.beat_in(connection)

    def beat_in(self, connection: sa.Connection) -> None:
        super().beat_in(connection)
        mine = sa.update(RUNS).where(RUNS.c.id == self.id)
        connection.execute(mine.values(done=self.done, total=self.total))

    def __exit__(self, *error: object) -> None:
        self._stop()
        raised, mine = error[1], RUNS.c.id == self.id
        if raised is None:
            status, self.done = COMPLETE, self.total or self.done
        else:
            status = INTERRUPTED if isinstance(raised, Interrupted | KeyboardInterrupt) else FAILED
        message = "" if raised is None else " ".join(str(raised).split())[:500]
        end = {"status": status, "message": message, "finished": now(), "done": self.done, "total": self.total}
        try:
            # if nothing was done, an earlier row is still the one to resume
            change = sa.delete(RUNS) if self._was_refused(raised) else sa.update(RUNS).values(**end)
            with self.database.writing() as connection:
                connection.execute(change.where(mine))
        except StorageError:
            if raised is None:  # otherwise show the first error
                raise
        finally:
            super().__exit__(*error)

    def _was_refused(self, error: object) -> bool:
        if not isinstance(error, CheckpointError):
            return isinstance(error, UsageError)
        with self.database.reading() as connection:
            study = connection.scalar(sa.select(STUDIES.c.id).where(STUDIES.c.name == self.name))
        return study is None and not (self.database.results / "artifacts" / self.kind / self.name).exists()


def _name_in(database: Database, kind: str, folder: Path) -> str:
    """Return the name under which the database stores an artifact (weights or data).

    It is the folder's name, or the whole path for a folder outside `<results>/artifacts/<kind>`.
    """
    return folder.name if folder.parent == database.results / "artifacts" / kind else str(folder.absolute())


def making(database: Database, kind: str, folder: Path) -> Run:
    """Return a new `Run` for a command that makes an artifact (weights or data). Use it in a `with` statement.

    Args:
        database: The database.
        kind: Kind of the artifact.
        folder: Folder of the artifact.
    """
    return Run(database, kind, _name_in(database, kind, folder))


def command_to_go_on(database: Database, kind: str, folder: Path) -> tuple[str, ...]:
    """Return the arguments after `kerv` that resume a command which makes an artifact (weights or data).

    Empty if the artifact is complete, or if the database has no row for it.
    """
    rows = run_rows(database, kind, _name_in(database, kind, folder))
    return tuple(rows[0].command) if rows and rows[0].status != COMPLETE else ()


def interrupted(database: Database, kind: str, command: Sequence[str]) -> str:
    """Return the name of what a command's newest run left unfinished. Empty if that run completed or never began."""
    row = next((row for row in run_rows(database, kind) if row.command == list(command)), None)
    return "" if row is None or row.status == COMPLETE else str(row.name)


def forget(database: Database, kind: str, name: str) -> None:
    """Delete all rows of commands that made this study or artifact (weights or data)."""
    with database.writing() as connection:
        connection.execute(sa.delete(RUNS).where(RUNS.c.kind == kind, RUNS.c.name == name))
