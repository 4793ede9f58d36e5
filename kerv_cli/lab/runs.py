"""The table `runs` of the database: one row per command that was started (a run).

A row says which process runs the command, how far it is, and how it ended.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.durations import left
from kerv_cli.base.errors import CheckpointError, Interrupted, StorageError, UsageError
from kerv_cli.lab.command import current_command
from kerv_cli.lab.database import EPISODES, RUNS, STUDIES, WORKERS, Database, now
from kerv_cli.lab.presence import Presence, living
from kerv_cli.targets.provenance import git_commit

RUNNING, COMPLETE, FAILED, INTERRUPTED = "running", "complete", "failed", "interrupted"


@dataclass(frozen=True)
class RunRow:
    """A row of the table `runs`: one command that was started.

    `status` is `running`, `complete`, `failed` or `interrupted`. A running command whose process is dead counts as
    interrupted. `seen` is its newest sign of life, seconds since 1970, 0 if it has ended.
    """

    id: str
    kind: str
    name: str
    command: tuple[str, ...]
    status: str
    done: int
    total: int
    message: str
    host: str
    started: str
    finished: str | None
    git_commit: str
    seen: float


_SEEN = sa.select(sa.func.max(WORKERS.c.heartbeat)).where(WORKERS.c.run == RUNS.c.id).scalar_subquery().label("seen")


def _rows(database: Database, connection: sa.Connection, query: sa.Select[Any]) -> list[RunRow]:
    alive, rows = set(living(database, connection).values()), []
    for row in connection.execute(query):
        status = INTERRUPTED if row.status == RUNNING and row.id not in alive else row.status
        rows.append(
            RunRow(**{**row._mapping, "command": tuple(row.command), "status": status, "seen": row.seen or 0.0})
        )
    return rows


def running(database: Database, connection: sa.Connection, kind: str, name: str) -> list[RunRow]:
    """Return the living commands that make a study or an artifact."""
    same = RUNS.c.kind == kind, RUNS.c.name == name, RUNS.c.status == RUNNING
    return [row for row in _rows(database, connection, sa.select(RUNS, _SEEN).where(*same)) if row.status == RUNNING]


def run_rows(database: Database, kind: str | None = None, name: str | None = None) -> list[RunRow]:
    """Return the commands that were started, newest first.

    Args:
        database: The database.
        kind: Only runs of this kind; None for all.
        name: Only runs that made this study or artifact; None for all.
    """
    query = sa.select(RUNS, _SEEN).order_by(RUNS.c.started.desc(), RUNS.c.id.desc())
    query = query if kind is None else query.where(RUNS.c.kind == kind)
    query = query if name is None else query.where(RUNS.c.name == name)
    with database.reading() as connection:
        return _rows(database, connection, query)


def time_left(row: RunRow) -> str:
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
        rows = _rows(database, connection, sa.select(RUNS, _SEEN).where(RUNS.c.status == RUNNING))
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
        others = running(self.database, connection, self.kind, self.name)
        if self.alone and others:
            whose = f"on {others[0].host} since {others[0].started[:16]}"
            raise UsageError(f"{self.kind} {self.name} is being made {whose}: wait for it, or choose another name")
        same = RUNS.c.kind == self.kind, RUNS.c.name == self.name, RUNS.c.status == RUNNING
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
        """Write a sign of life and the progress, in a transaction."""
        super().beat_in(connection)
        progress = sa.update(RUNS).where(RUNS.c.id == self.id).values(done=self.done, total=self.total)
        connection.execute(progress)

    def _end(self, **values: Any) -> None:
        with self.database.writing() as connection:
            ended = {"done": self.done, "total": self.total, "finished": now(), **values}
            connection.execute(sa.update(RUNS).where(RUNS.c.id == self.id).values(**ended))

    def __exit__(self, *error: object) -> None:
        self._stop()
        raised = error[1]
        try:
            if self._was_refused(raised):  # nothing was done: an earlier row is still the one to resume
                with self.database.writing() as connection:
                    connection.execute(sa.delete(RUNS).where(RUNS.c.id == self.id))
            elif raised is None:
                self.done = self.total or self.done
                self._end(status=COMPLETE)
            else:
                status = INTERRUPTED if isinstance(raised, Interrupted | KeyboardInterrupt) else FAILED
                self._end(status=status, message=" ".join(str(raised).split())[:500])
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
    """Return the arguments after `kerv` that resume the making of an artifact (weights or data).

    Empty if the artifact is complete, or if the database has no row for it.
    """
    rows = run_rows(database, kind, _name_in(database, kind, folder))
    return rows[0].command if rows and rows[0].status != COMPLETE else ()


def interrupted(database: Database, kind: str, command: Sequence[str]) -> RunRow | None:
    """Return the newest row of a command (without `kerv`) if it did not complete."""
    row = next((row for row in run_rows(database, kind) if row.command == tuple(command)), None)
    return None if row is None or row.status == COMPLETE else row


def forget(database: Database, kind: str, name: str) -> None:
    """Delete all rows of commands that made this study or artifact (weights or data)."""
    with database.writing() as connection:
        connection.execute(sa.delete(RUNS).where(RUNS.c.kind == kind, RUNS.c.name == name))
