"""Rows of the commands that were begun: who runs each, how far it is, how it ended."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import Interrupted, KervError, StorageError, UsageError
from kerv_cli.base.leftovers import is_alive
from kerv_cli.base.places import results_dir
from kerv_cli.lab.command import current_command
from kerv_cli.lab.database import METRICS, RUNS, Database, now
from kerv_cli.targets.provenance import git_commit

RUNNING, COMPLETE, FAILED, INTERRUPTED = "running", "complete", "failed", "interrupted"

BEAT_SECONDS = 5.0
"""Time between two heartbeats of a run."""
STALE_SECONDS = 900.0
"""A run on another machine counts as dead after this time without a heartbeat."""

_open: set[str] = set()
"""Ids of this process's runs that have not ended. A full disk can refuse to write the end of one."""


@dataclass(frozen=True)
class RunRow:
    """A row of the table `runs`; `status` is `interrupted` if its process is dead."""

    id: str
    kind: str
    name: str
    command: tuple[str, ...]
    status: str
    done: int
    total: int
    message: str
    host: str
    pid: int
    started: str
    finished: str | None
    heartbeat: float
    git_commit: str


def _row_of(row: Any) -> RunRow:
    if row.host != socket.gethostname():
        is_live = time.time() - row.heartbeat < STALE_SECONDS
    else:
        is_live = row.id in _open if row.pid == os.getpid() else is_alive(row.pid)
    status = INTERRUPTED if row.status == RUNNING and not is_live else row.status
    return RunRow(**{**row._mapping, "command": tuple(row.command), "status": status})


def is_running(connection: sa.Connection, run: str) -> bool:
    """Return whether the run with this id may still be at work."""
    row = connection.execute(sa.select(RUNS).where(RUNS.c.id == run)).first()
    return row is not None and _row_of(row).status == RUNNING


def run_rows(database: Database, kind: str | None = None, name: str | None = None) -> list[RunRow]:
    """Return the begun commands, the newest first.

    Args:
        database: Where they are.
        kind: Only those of this kind.
        name: Only those of this study or artifact.
    """
    query = sa.select(RUNS).order_by(RUNS.c.started.desc(), RUNS.c.heartbeat.desc(), RUNS.c.id.desc())
    query = query if kind is None else query.where(RUNS.c.kind == kind)
    query = query if name is None else query.where(RUNS.c.name == name)
    with database.reading() as connection:
        return [_row_of(row) for row in connection.execute(query)]


class Run:
    """The row of a command from its first second to its end, with a heartbeat of its own thread.

    A context manager. A command that ends with a UsageError leaves no row.

    Args:
        database: Where the row is written.
        kind: sweep, rollout, import, or the kind of artifact that is made.
        name: Name of the study or the artifact.
        command: Words after `kerv` that go on with it. Default: those of `current_command`.
        total: Number of steps or episodes.
        alone: Refuse to begin while another process makes the same.

    Raises:
        UsageError: Another process makes the same.
        StorageError: The disk refused.
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
        self.database, self.kind, self.name, self.alone = database, kind, name, alone
        self.command = list(command) or current_command()
        self.id = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"
        self.total, self.done = total, 0
        self._ended = threading.Event()
        self._heart = threading.Thread(target=self._keep_beating, daemon=True)

    def __enter__(self) -> Run:
        host, pid = socket.gethostname(), os.getpid()
        same = sa.and_(RUNS.c.kind == self.kind, RUNS.c.name == self.name, RUNS.c.status == RUNNING)
        with self.database.writing() as connection:
            for row in map(_row_of, connection.execute(sa.select(RUNS).where(same)).all()):
                if row.status != RUNNING:
                    connection.execute(sa.update(RUNS).where(RUNS.c.id == row.id).values(status=row.status))
                elif self.alone and (row.host, row.pid) != (host, pid):
                    raise UsageError(
                        f"{self.kind} {self.name} is being made by process {row.pid} on {row.host} since "
                        f"{row.started[:16]}: wait for it, or choose another name"
                    )
            connection.execute(
                sa.insert(RUNS).values(
                    id=self.id, kind=self.kind, name=self.name, command=self.command, status=RUNNING, done=0,
                    total=self.total, message="", host=host, pid=pid, started=now(), heartbeat=time.time(),
                    git_commit=git_commit(),
                )
            )  # fmt: skip
        _open.add(self.id)
        self._heart.start()
        return self

    def beat(self, done: int, total: int | None = None) -> None:
        """Note progress. The next heartbeat writes it; a new total is written at once."""
        is_new = total not in (None, self.total)
        self.done, self.total = done, self.total if total is None else total
        if is_new:
            self._update()

    def _keep_beating(self) -> None:
        while not self._ended.wait(BEAT_SECONDS):
            with contextlib.suppress(KervError):  # the command itself meets the same error and shows it
                self._update()

    def _update(self, **values: Any) -> None:
        values |= {"done": self.done, "total": self.total, "heartbeat": time.time()}
        with self.database.writing() as connection:
            connection.execute(sa.update(RUNS).where(RUNS.c.id == self.id).values(**values))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._heart.join()
        _open.discard(self.id)
        try:
            if isinstance(error, UsageError):  # nothing was begun: an earlier command is still the one that goes on
                with self.database.writing() as connection:
                    connection.execute(sa.delete(RUNS).where(RUNS.c.id == self.id))
            elif error is None:
                self.done = self.total or self.done
                self._update(status=COMPLETE, finished=now())
            else:
                status = INTERRUPTED if isinstance(error, Interrupted | KeyboardInterrupt) else FAILED
                self._update(status=status, message=" ".join(str(error).split())[:500], finished=now())
        except StorageError:
            if error is None:  # otherwise show the first error
                raise


def name_in(results: str | Path, kind: str, folder: Path) -> str:
    """Return an artifact's name: that of its folder, or the whole path outside `<results>/artifacts`."""
    return folder.name if folder.parent == results_dir(str(results)) / "artifacts" / kind else str(folder.absolute())


def making(results: str | Path, kind: str, folder: Path, command: Sequence[str] = ()) -> Run:
    """Return the run of a command that makes an artifact in a folder; see `Run`."""
    return Run(Database(results), kind, name_in(results, kind, folder), command)


def command_to_go_on(results: str | Path, kind: str, folder: Path) -> tuple[str, ...]:
    """Return the words after `kerv` that go on with an unfinished artifact; empty if no row has them."""
    rows = run_rows(Database(results), kind, name_in(results, kind, folder))
    return rows[0].command if rows and rows[0].status != COMPLETE else ()


@dataclass(frozen=True)
class Curve:
    """The validations of a training as rows of the database."""

    database: Database
    kind: str
    name: str

    @staticmethod
    def of(folder: Path, results: str | Path | None = None) -> Curve:
        """Return the curve of the training in a folder.

        Args:
            folder: Folder of the artifact.
            results: The results folder. Default: the folder that holds its `artifacts`.
        """
        results, kind = results or folder.parents[2], folder.parent.name
        return Curve(Database(results), kind, name_in(results, kind, folder))

    def write(self, history: Sequence[Mapping[str, float]]) -> None:
        """Replace all rows by these validations. Each maps metrics to values, with its `step`."""
        rows = [
            {"kind": self.kind, "name": self.name, "step": int(one["step"]), "metric": metric, "value": float(value)}
            for one in history
            for metric, value in one.items()
            if metric != "step"
        ]
        with self.database.writing() as connection:
            connection.execute(sa.delete(METRICS).where(METRICS.c.kind == self.kind, METRICS.c.name == self.name))
            if rows:
                connection.execute(sa.insert(METRICS), rows)

    def read(self) -> list[dict[str, float]]:
        """Return the validations in order."""
        query = sa.select(METRICS).where(METRICS.c.kind == self.kind, METRICS.c.name == self.name)
        history: dict[int, dict[str, float]] = {}
        with self.database.reading() as connection:
            for row in connection.execute(query.order_by(METRICS.c.step)):
                history.setdefault(row.step, {"step": row.step})[row.metric] = row.value
        return list(history.values())


def unfinished(database: Database, kind: str, command: Sequence[str]) -> RunRow | None:
    """Return the newest row of a command, or None if it is complete or there is none."""
    row = next((row for row in run_rows(database, kind) if row.command == tuple(command)), None)
    return None if row is None or row.status == COMPLETE else row


def forget(database: Database, kind: str, name: str) -> None:
    """Delete the rows of all commands that made this study or artifact, and its curve."""
    with database.writing() as connection:
        for table in (RUNS, METRICS):
            connection.execute(sa.delete(table).where(table.c.kind == kind, table.c.name == name))


def interrupted_since(database: Database, kind: str, name: str, command: Sequence[str]) -> str:
    """Return when the interrupted command began that this one goes on with (ISO 8601); empty if there is none.

    It has the same words and was never complete.
    """
    since = ""
    for row in run_rows(database, kind, name):
        if row.command != tuple(command) or row.status == COMPLETE:
            break
        since = row.started
    return since
