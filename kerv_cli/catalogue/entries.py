"""List what a results folder contains: studies, artifacts (weights and data), and commands that were started."""

from __future__ import annotations

import contextlib
import csv
import fnmatch
import os
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from operator import attrgetter
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import KervError, UnknownName, UsageError
from kerv_cli.base.files import clean, read_mapping, set_aside, sha256_of, unfinished, visible
from kerv_cli.base.manifests import content_of
from kerv_cli.base.paths import shipped_dir
from kerv_cli.base.registry import ArtifactPart
from kerv_cli.episodes.identity import OBSERVATION
from kerv_cli.lab.database import EPISODES, SETTINGS, STUDIES, WANTED, Database
from kerv_cli.lab.runs import COMPLETE, RUNNING, forget, run_rows, time_left
from kerv_cli.lab.store import ROLLOUT, SWEEP, Study, remove_study

LOG, WEIGHTS = "log.csv", "model.safetensors"  # files of a training
# Argument of commands that stands for the newest entry
LAST = "last"
_STUDIES = (SWEEP, ROLLOUT)
_STATES = ("complete", "begun", "damaged", "step ", "running", "interrupted", "failed")
_FILTERS = ("kind", "method", "task", "state")


def artifact_kinds() -> tuple[str, ...]:
    return ("demos", "target", *ArtifactPart.every())


@dataclass(frozen=True)
class RunEntry:
    """One entry of the list that `kerv runs` shows: a study, an artifact, or an interrupted command."""

    id: str  # name by which commands find the entry
    kind: str  # sweep, rollout, or a kind of artifact
    folder: Path
    started: str  # UTC (ISO 8601). For an artifact, the time when its newest file changed.
    state: str  # for example `complete`, `interrupted, 2 of 6 episodes`, `step 300 of 600`, `begun` or `damaged`
    methods: tuple[str, ...] = ()  # decoding methods of the study's settings. For an artifact, only its kind.
    tasks: tuple[str, ...] = ()
    episodes: int = 0
    total: int = 0  # number of episodes or training steps that were planned. 0 if unknown.
    done: int = 0  # number of these that are finished
    # estimated remaining time, such as `about 3 min left`. Empty if unknown, or if the entry is not running.
    left: str = ""
    message: str = ""  # error message of the newest command that makes the entry
    # main results of the entry by name, such as the success rate
    figures: dict[str, float] = field(default_factory=dict)
    command: tuple[str, ...] = ()  # command-line arguments (without `kerv`) that made the entry. Empty if unknown.
    sha256: str = ""  # hash by which other entries refer to this artifact
    # hashes of the artifacts that the entry was made from, by kind. If the settings of a study use several of one
    # kind, the keys of the others are `drafter of LABEL`. `init`: the target whose weights a training started from.
    made_from: dict[str, str] = field(default_factory=dict)

    @property
    def command_line(self) -> str:
        return shlex.join(["kerv", *self.command]) if self.command else ""

    @property
    def has_episodes(self) -> bool:
        return self.kind in _STUDIES

    @property
    def is_running(self) -> bool:
        return self.state.startswith(RUNNING)


def few(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" +{len(names) - most}" if len(names) > most else "")


def find_runs(database: Database) -> list[RunEntry]:
    """Return all entries of a database and its results folder, newest first."""
    folder = database.results / "artifacts"
    for name in ("studies", "rollouts"):
        clean(database.results / name)
    found = {(one.kind, one.folder.name): one for one in _studies(database)}
    for kind in artifact_kinds():
        clean(folder / kind)
        for path in visible(folder / kind):
            # an interrupted recording and a training before its first validation have no description yet
            if any(map(Path.is_file, (_description(path, kind), path / "recording.json", path / LOG))):
                found[kind, path.name] = artifact_entry(path, kind)
    finished, newest = set(), {}
    for row in reversed(run_rows(database)):
        newest[row.kind, row.name] = row
        if row.status == COMPLETE:
            finished.add((row.kind, row.name, *row.command))
    for (kind, name), row in newest.items():
        entry = found.get((kind, name))
        if entry is None:
            if kind in _STUDIES or row.status == COMPLETE:
                continue  # what the command made was removed
            entry = RunEntry(f"{kind}/{name}", kind, folder / kind / name, "", "", (kind,))
        found[kind, name] = _with_command(entry, row, (kind, name, *row.command) in finished)
    return sorted(found.values(), key=attrgetter("started", "id"), reverse=True)


def _with_command(entry: RunEntry, row: Any, is_finished: bool) -> RunEntry:
    entry, is_running = replace(entry, command=tuple(row.command)), row.status == RUNNING
    is_repeat = is_finished and entry.state == COMPLETE
    if not entry.has_episodes and (row.status == COMPLETE or (is_repeat and not is_running)):
        return entry
    entry = replace(entry, left=time_left(row), message=row.message)
    if entry.has_episodes:
        is_open = is_running or COMPLETE not in (entry.state, row.status)
        state = f"{row.status}, {entry.done} of {entry.total} episodes" if is_open else entry.state
        return replace(entry, started=entry.started if entry.episodes else row.started[:23], state=state)
    state = f"{row.status}, {row.done} of {row.total}" if row.total else row.status
    started = entry.started if is_repeat else row.started[:23]
    return replace(entry, started=started, state=state, done=row.done, total=row.total)


def find_run(database: Database, name: str, exact: bool = False) -> RunEntry:
    """Return the entry with an id. Unless `exact`, a unique part of the id is enough, and `last` means the newest."""
    runs = find_runs(database)
    if not runs:
        raise UsageError(f"no runs in {database.results}: make one with 'kerv rollout method=spec_vla task=reach'")
    if name == LAST and not exact:
        return runs[0]
    found = [one for one in runs if one.id == name] or [one for one in runs if name in one.id and not exact]
    if len(found) > 1:
        raise UsageError(f"'{name}' is a part of {len(found)} runs: {', '.join(one.id for one in found[:5])}")
    if not found:
        raise UnknownName("run", name, map(attrgetter("id"), runs))
    return found[0]


def matching(runs: Sequence[RunEntry], filters: dict[str, str]) -> list[RunEntry]:
    """Return the entries that match every filter.

    `kind` is the exact kind. `method` and `task` are names or patterns such as `drawer*`. `state` is the beginning of a
    state.
    """
    for key in filters:
        if key not in _FILTERS:
            raise UnknownName("filter", key, _FILTERS)
    kinds = (*_STUDIES, *artifact_kinds())
    if filters.get("kind", SWEEP) not in kinds:
        raise UnknownName("kind of run", filters["kind"], kinds)
    state, task = filters.get("state", ""), filters.get("task", "*")
    if not any(one.startswith(state) or state.startswith(one) for one in _STATES) and not state[:1].isdigit():
        raise UnknownName("state", state, [*map(str.strip, _STATES), "2 of 6 episodes"])

    def agrees(run: RunEntry) -> bool:
        return (
            run.kind == filters.get("kind", run.kind)
            and ("method" not in filters or bool(fnmatch.filter(run.methods, filters["method"])))
            and ("task" not in filters or f"{task}-v3" in run.tasks or bool(fnmatch.filter(run.tasks, task)))
            and run.state.startswith(state)
        )

    return list(filter(agrees, runs))


def store_of(run: RunEntry, database: Database) -> Study:
    if not run.has_episodes:
        raise UsageError(f"{run.id} is a {run.kind}: it has no episodes")
    return Study(database, run.folder.name, run.kind)


def _studies(database: Database) -> Iterator[RunEntry]:
    every = WANTED.join(SETTINGS).outerjoin(EPISODES, EPISODES.c.id == WANTED.c.episode_id)
    group = SETTINGS.c.study_id, WANTED.c.task
    sums = sa.select(
        *group, sa.func.count().label("all"), sa.func.count(WANTED.c.episode_id).label("existing"),
        sa.func.min(EPISODES.c.started).label("started"),
        sa.func.sum(sa.cast(EPISODES.c.success, sa.Integer)).label("successes"),
    ).select_from(every).group_by(*group).order_by(WANTED.c.task)  # fmt: skip
    of_setting = sa.select(SETTINGS.c.study_id, SETTINGS.c.label, SETTINGS.c.method, SETTINGS.c.identity).order_by(
        SETTINGS.c.position
    )
    with database.reading() as connection:
        studies, tasks = connection.execute(sa.select(STUDIES)).all(), connection.execute(sums).all()
        settings = connection.execute(of_setting).all()
    for study in studies:
        methods, made_from = dict[str, None](), dict[str, str]()
        for one in settings:
            if one.study_id == study.id:
                methods[one.method] = None
                for kind, value in one.identity.items():
                    if kind != OBSERVATION and value and value not in made_from.values():
                        made_from[f"{kind} of {one.label}" if kind in made_from else kind] = value
        mine = [one for one in tasks if one.study_id == study.id]
        total, existing = sum(one.all for one in mine), sum(one.existing for one in mine)
        successes = sum(one.successes or 0 for one in mine)
        yield RunEntry(
            id=study.name,
            kind=study.kind,
            folder=Study(database, study.name, study.kind).root,
            started=min(filter(None, (one.started for one in mine)), default=study.created)[:23],
            state=COMPLETE if existing == total else f"{existing} of {total} episodes",
            methods=tuple(methods),
            tasks=tuple(one.task for one in mine),
            episodes=existing,
            total=total,
            done=existing,
            figures={"success": successes / existing} if existing else {},
            made_from=made_from,
        )


def description_of(run: RunEntry) -> dict[str, Any]:
    """Return the provenance of an artifact: the command, settings and data that made it. Empty if unknown."""
    return dict(_described(run.folder, run.kind).get("provenance") or {})


def _described(folder: Path, kind: str) -> dict[str, Any]:
    path = _description(folder, kind)
    return read_mapping(path) if path.exists() else {}


def _description(folder: Path, kind: str) -> Path:
    part = ArtifactPart.every().get(kind)
    own = part.described_by if part is not None else "manifest.json" if kind == "demos" else None
    return folder / (own or f"{kind}.json")


def artifact_entry(folder: Path, kind: str) -> RunEntry:
    """Return the entry of an artifact in a folder. Its state is `damaged` if its files cannot be read."""
    changed = map(os.path.getmtime, filter(Path.is_file, visible(folder)))
    started = datetime.fromtimestamp(max(changed, default=0.0), UTC).isoformat(timespec="milliseconds")[:23]
    run = RunEntry(f"{kind}/{folder.name}", kind, folder, started, "damaged")
    try:
        value = _described(folder, kind)
        provenance = dict(value.get("provenance") or {})
        settings = dict(provenance.get("settings") or {})
        figures = {name: float(value[name]) for name in ("episodes", "rows") if isinstance(value.get(name), int)}
        figures |= {name: float(number) for name, number in dict(provenance.get("validation") or {}).items()}
        sha256 = str(value.get("sha256") or (sha256_of(_description(folder, kind)) if value else ""))
        state = "complete" if value or (folder / WEIGHTS).is_file() else "begun"  # copied weights have no description
        if (folder / LOG).is_file():
            rows = list(csv.DictReader((folder / LOG).read_text().splitlines()))
            steps, step = int(settings.get("train", {}).get("steps", 0)), float(rows[-1]["step"]) if rows else 0.0
            state = "complete" if step >= steps else f"step {step:.0f} of {steps}"
        if value.get("kind") == "datastore":
            sha256 = content_of(value["key"], value["chunk"], value["target"], value["files"])
        return replace(
            run,
            state=state,
            methods=(kind,),
            tasks=tuple(settings.get("task") or value.get("tasks") or ()),
            episodes=int(value.get("episodes", 0)) if kind == "demos" else 0,
            figures=figures,
            command=tuple(str(provenance.get("command", "")).split()[1:]),
            sha256=sha256,
            made_from=_made_from(value, provenance),
        )
    except (KervError, OSError, ValueError, TypeError, AttributeError, KeyError, csv.Error):
        return run


def _made_from(value: Mapping[str, Any], provenance: Mapping[str, Any]) -> dict[str, str]:
    hashes: dict[str, str] = {}
    for kind, entry in (("target", value.get("target")), ("demos", value.get("demos") or provenance.get("demos"))):
        sha256 = entry.get("sha256") if isinstance(entry, Mapping) else entry
        hashes |= {kind: str(sha256)} if sha256 else {}
    return hashes | ({"init": str(provenance["init"])} if provenance.get("init") else {})


def parents(run: RunEntry, runs: Sequence[RunEntry]) -> dict[str, str]:
    """Return what an entry was made from, by kind: an entry's id, `shipped NAME`, or else 12 digits of a hash."""
    names = {other.sha256: other.id for other in runs}
    for folder in visible(shipped_dir()):
        for kind in artifact_kinds():
            with contextlib.suppress(KervError):
                names.setdefault(str(_described(folder / kind, kind).get("sha256", "")), f"shipped {folder.name}")
    return {kind: names.get(value, value[:12]) for kind, value in run.made_from.items()}


def children(run: RunEntry, runs: Sequence[RunEntry]) -> list[RunEntry]:
    return [other for other in runs if run.sha256 and run.sha256 in other.made_from.values()]


def disk_bytes(folder: Path) -> int:
    return sum(map(os.path.getsize, filter(Path.is_file, folder.rglob("*"))))


def check_removable(run: RunEntry) -> None:
    if run.folder.is_symlink():
        raise UsageError(f"{run.folder} is a link to {os.readlink(run.folder)}: remove the link, or what it points to")
    if run.is_running:
        raise UsageError(f"{run.id} is running: stop it first")


def remove(run: RunEntry, database: Database) -> None:
    """Remove an entry: its folder, which is first renamed, and its rows in the database.

    If this process is killed before the rows are deleted, the entry is still listed and can be removed again.
    """
    gone = set_aside(run.folder)
    if run.has_episodes:
        remove_study(store_of(run, database))
    forget(database, run.kind, run.id if run.has_episodes else run.id.removeprefix(f"{run.kind}/"))
    for folder in (gone, unfinished(run.folder)):
        shutil.rmtree(folder, ignore_errors=True)
