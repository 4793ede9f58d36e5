"""run.json beside a plan: the commands that ran it, as they were typed."""

from __future__ import annotations

import contextlib
import shlex
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json, write_json
from kerv_cli.base.manifests import read
from kerv_cli.base.provenance import git_commit

FORMAT = 1


@dataclass(frozen=True)
class Invocation:
    """One command that ran cells of a run. arguments: behind `kerv`. started, finished: ISO 8601, UTC; the second is
    empty where it was interrupted or failed. git_commit: of kerv."""

    arguments: tuple[str, ...]
    started: str
    git_commit: str
    finished: str = ""


@dataclass(frozen=True)
class RunFile:
    """Contents of run.json, the oldest command first."""

    commands: tuple[Invocation, ...]
    format: int = FORMAT


def note_invocation(folder: Path, arguments: list[str]) -> None:
    """Appends a command to a run's run.json.

    Raises:
        StorageError: the disk refused.
    """
    _write(folder, (*invocations(folder), Invocation(tuple(arguments), _now(), git_commit())))


def note_finished(folder: Path) -> None:
    """Notes that the last command came to its end.

    Raises:
        StorageError: the disk refused.
    """
    *before, last = invocations(folder)
    _write(folder, (*before, replace(last, finished=_now())))


def interrupted_since(folder: Path, arguments: list[str]) -> str:
    """When the command was begun that this one goes on with: the same arguments, never finished. Empty where there is
    none."""
    since = ""
    for command in reversed(invocations(folder)):
        if command.arguments != tuple(arguments) or command.finished:
            break
        since = command.started
    return since


def sweep_command(folder: Path, name: str, *further: str) -> str:
    """The command that runs the study in this folder, as it was typed last; without a record, by its name. further:
    overrides to add."""
    sweeps = (command.arguments for command in reversed(invocations(folder)) if command.arguments[:1] == ("sweep",))
    words = list(next(sweeps, ("sweep", f"study={name}")))
    words = [word for word in words if not word.startswith(("results=", "rerun=", "-"))]
    return shlex.join(["kerv", *words, *further])


def _write(folder: Path, commands: tuple[Invocation, ...]) -> None:
    write_json(_path(folder), asdict(RunFile(commands)))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def invocations(folder: Path) -> tuple[Invocation, ...]:
    """The commands in a run's run.json; none where it is missing or damaged."""
    with contextlib.suppress(CheckpointError):
        return read(RunFile, read_json(_path(folder)), str(_path(folder)), tolerant=True).commands
    return ()


def _path(folder: Path) -> Path:
    return folder / "run.json"
