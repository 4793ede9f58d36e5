"""run.json beside a plan: the commands that ran it, as they were typed."""

from __future__ import annotations

import contextlib
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from kerv_cli.errors import CheckpointError
from kerv_cli.files import read_json, write_json
from kerv_cli.manifests import read
from kerv_cli.provenance import git_commit
from kerv_cli.studies.store import StudyStore

FORMAT = 1


@dataclass(frozen=True)
class Invocation:
    """One command that ran cells of a run. arguments: behind `kerv`. started: ISO 8601, UTC. git_commit: of kerv."""

    arguments: tuple[str, ...]
    started: str
    git_commit: str


@dataclass(frozen=True)
class RunFile:
    """Contents of run.json, the oldest command first."""

    commands: tuple[Invocation, ...]
    format: int = FORMAT


def note_invocation(store: StudyStore, arguments: list[str]) -> None:
    """Appends a command to the store's run.json.

    Raises:
        StorageError: the disk refused.
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    commands = (*invocations(store), Invocation(tuple(arguments), now, git_commit()))
    write_json(_path(store), asdict(RunFile(commands)))


def invocations(store: StudyStore) -> tuple[Invocation, ...]:
    """The commands in the store's run.json; none where it is missing or damaged."""
    with contextlib.suppress(CheckpointError):
        return read(RunFile, read_json(_path(store)), str(_path(store))).commands
    return ()


def _path(store: StudyStore) -> Path:
    return store.root / "run.json"
