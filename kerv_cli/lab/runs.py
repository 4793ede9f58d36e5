"""Every begun command as a row: who runs it, how far it is, how it ended."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import Interrupted, StorageError, UsageError
from kerv_cli.base.places import results_dir
from kerv_cli.base.provenance import git_commit
from kerv_cli.lab.database import (
    BEAT_SECONDS,
    COMPLETE,
    FAILED,
    INTERRUPTED,
    METRICS,
    RUNNING,
    RUNS,
    Database,
    is_live,
    new_id,
    now,
)

_command: list[str] = []
_open: set[str] = set()
"""Ids of the runs of this process that have not ended: a full disk can refuse to write the end of one."""


def set_command(words: Sequence[str]) -> list[str]:
    """Note the words after `kerv` of the command that this process runs, and return those noted before."""
    before = list(_command)
    _command[:] = words
    return before


@dataclass(frozen=True)
class RunRow:
    """A row of the table `runs`. status: running, complete, failed or interrupted; of a dead process interrupted."""

    id: str
    kind: str
    name: str
    command: tuple[str, ...]
    status: str
    done: int
    total: int
    message: str
    started: str
    finished: str
    git_commit: str


def _is_at_work(row: Any) -> bool:
    mine = (row.host, row.pid) == (socket.gethostname(), os.getpid())
    live = row.id in _open if mine else is_live(row.host, row.pid, row.heartbeat)
    return live and row.status == RUNNING


def is_running(connection: sa.Connection, run: str) -> bool:
    """Return whether the run of this id may still be at work."""
    row = connection.execute(sa.select(RUNS).where(RUNS.c.id == run)).first()
    return row is not None and _is_at_work(row)


def _row_of(row: Any) -> RunRow:
    dead = row.status == RUNNING and not _is_at_work(row)
    return RunRow(
        row.id, row.kind, row.name, tuple(row.command), INTERRUPTED if dead else row.status, row.done, row.total,
        row.message, row.started, row.finished or "", row.git_commit,
    )  # fmt: skip


def run_rows(database: Database, kind: str | None = None, name: str | None = None) -> list[RunRow]:
    """Return the begun commands, the newest first; those of a kind and name if these are given."""
    query = sa.select(RUNS).order_by(RUNS.c.started.desc(), RUNS.c.heartbeat.desc(), RUNS.c.id.desc())
    query = query if kind is None else query.where(RUNS.c.kind == kind)
    query = query if name is None else query.where(RUNS.c.name == name)
    with database.reading() as connection:
        return [_row_of(row) for row in connection.execute(query)]


class Run:
    """The row of a command from its first second to its end; a context manager.

    A command that ends with a UsageError leaves no row.

    Args:
        database: Where the row is written.
        kind: sweep, rollout, import, or the kind of artifact that is made.
        name: Of the study or the artifact.
        command: Words after `kerv` that go on with it; by default those of `set_command`.
        total: Steps or episodes, for the progress.
        alone: Refuse to begin while another process makes the same.

    Raises:
        UsageError: Another process makes it. StorageError: The disk refused.
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
        self.command = list(command or _command)
        self.id, self.total, self.done = new_id(), total, 0
        self._beaten = 0.0

    def __enter__(self) -> Run:
        same = sa.and_(RUNS.c.kind == self.kind, RUNS.c.name == self.name, RUNS.c.status == RUNNING)
        with self.database.writing() as connection:
            for row in connection.execute(sa.select(RUNS).where(same)).all():
                if not _is_at_work(row):
                    connection.execute(sa.update(RUNS).where(RUNS.c.id == row.id).values(status=INTERRUPTED))
                elif self.alone and (row.host, row.pid) != (socket.gethostname(), os.getpid()):
                    raise UsageError(
                        f"{self.kind} {self.name} is being made by process {row.pid} on {row.host} since "
                        f"{row.started[:16]}: wait for it, or choose another name"
                    )
            connection.execute(
                sa.insert(RUNS).values(
                    id=self.id, kind=self.kind, name=self.name, command=self.command, status=RUNNING, done=0,
                    total=self.total, message="", host=socket.gethostname(), pid=os.getpid(), started=now(),
                    heartbeat=time.time(), git_commit=git_commit(),
                )
            )  # fmt: skip
        _open.add(self.id)
        return self

    def beat(self, done: int | None = None, total: int | None = None, at_once: bool = False) -> None:
        """Note progress and that the process lives, at most every BEAT_SECONDS."""
        at_once |= total not in (None, self.total)  # another part of the work began
        self.done = self.done if done is None else done
        self.total = self.total if total is None else total
        if time.monotonic() - self._beaten < BEAT_SECONDS and not at_once:
            return
        self._beaten = time.monotonic()
        self._update(done=self.done, total=self.total, heartbeat=time.time())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _open.discard(self.id)
        if isinstance(error, UsageError):  # nothing was begun: an earlier command is still the one that goes on
            with contextlib.suppress(StorageError), self.database.writing() as connection:
                connection.execute(sa.delete(RUNS).where(RUNS.c.id == self.id))
            return
        if error is None:
            status, done = COMPLETE, self.total or self.done
        else:
            status, done = INTERRUPTED if isinstance(error, Interrupted | KeyboardInterrupt) else FAILED, self.done
        message = "" if error is None else " ".join(str(error).split())[:500]
        try:
            self._update(
                status=status, done=done, total=self.total, message=message, finished=now(), heartbeat=time.time()
            )
        except StorageError:
            if error is None:  # else that one is to be shown
                raise

    def _update(self, **values: Any) -> None:
        with self.database.writing() as connection:
            connection.execute(sa.update(RUNS).where(RUNS.c.id == self.id).values(**values))


def name_in(results: str | Path, kind: str, folder: Path) -> str:
    """Return an artifact's name: that of its folder, or the whole path outside `<results>/artifacts`."""
    return folder.name if folder.parent == results_dir(str(results)) / "artifacts" / kind else str(folder.absolute())


def making(results: str | Path, kind: str, folder: Path, command: Sequence[str] = ()) -> Run:
    """Return the row of a command that makes an artifact in a folder; see `Run`."""
    return Run(Database(results), kind, name_in(results, kind, folder), command)


def command_to_go_on(results: str | Path, kind: str, folder: Path) -> tuple[str, ...]:
    """Return the words after `kerv` that go on with an unfinished artifact; none if no row has them."""
    rows = run_rows(Database(results), kind, name_in(results, kind, folder))
    return rows[0].command if rows and rows[0].status != COMPLETE else ()


@dataclass(frozen=True)
class Curve:
    """The validations of a training as rows."""

    database: Database
    kind: str
    name: str

    @staticmethod
    def of(folder: Path, results: str | Path | None = None) -> Curve:
        """Return the curve of a training's folder. results: by default the folder above its `artifacts`."""
        results, kind = results or folder.parents[2], folder.parent.name
        return Curve(Database(results), kind, name_in(results, kind, folder))

    def write(self, history: Sequence[Mapping[str, float]]) -> None:
        """Replace the rows by these validations; each has its `step` among the metrics."""
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


def forget(database: Database, kind: str, name: str) -> None:
    """Delete the rows of all commands that made this, and its curve."""
    with database.writing() as connection:
        for table in (RUNS, METRICS):
            connection.execute(sa.delete(table).where(table.c.kind == kind, table.c.name == name))


def interrupted_since(database: Database, kind: str, name: str, command: Sequence[str]) -> str:
    """Return when the command was begun that this one goes on with: the same words, never complete; empty: none."""
    since = ""
    for row in run_rows(database, kind, name):
        if row.command != tuple(command) or row.status == COMPLETE:
            break
        since = row.started
    return since
