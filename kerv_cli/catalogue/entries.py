"""The runs of a results folder: the studies of its database, and its folders of what was trained, recorded, built or
calibrated, with the rows of the commands that were begun."""

from __future__ import annotations

import contextlib
import csv
import fnmatch
import io
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.config import as_overrides, compose, groups
from kerv_cli.base.errors import KervError, UnknownName, UsageError
from kerv_cli.base.files import read_mapping, read_text, sha256_of, storage_errors, sync, visible
from kerv_cli.base.leftovers import clean, temporary_beside
from kerv_cli.base.manifests import content_of
from kerv_cli.base.places import shipped_dir
from kerv_cli.base.registry import parts
from kerv_cli.base.settings import choices_of
from kerv_cli.episodes.identity import OBSERVATION
from kerv_cli.lab.database import COMPLETE, EPISODES, RUNNING, SETTINGS, STUDIES, WANTED, Database
from kerv_cli.lab.runs import RunRow, forget, run_rows
from kerv_cli.lab.store import IMPORT, ROLLOUT, SWEEP, StudyStore
from kerv_cli.methods.settings import with_artifacts

OLDER = ("risk", "score")
"""Kinds of artifacts that an older kerv made."""
LOG, WEIGHTS = "log.csv", "model.safetensors"
"""Files of a training."""
POLICY = "policy"
"""What `kerv build policy` installs; it is listed while it is unfinished."""
LAST = "last"
"""Stands for the newest run where one is named."""


def artifact_kinds() -> tuple[str, ...]:
    """Kinds of what is recorded, trained, built and calibrated, those of plugins among them."""
    return ("demos", "target", *parts("artifact"))


@dataclass(frozen=True)
class RunEntry:
    """One run. id: how commands name it. state: `complete`, `2 of 6 episodes`, `step 300 of 600`, `begun`, `damaged`.
    figures: its headline, by name. command: words behind `kerv`; empty where no record has them. sha256: by which
    others name it. made_from: kind -> that hash of each artifact that it was made from."""

    id: str
    kind: str
    folder: Path
    started: str  # ISO 8601, UTC; of an artifact: when its newest file changed
    state: str
    methods: tuple[str, ...] = ()
    tasks: tuple[str, ...] = ()
    episodes: int = 0
    figures: dict[str, float] = field(default_factory=dict)
    command: tuple[str, ...] = ()
    sha256: str = ""
    made_from: dict[str, str] = field(default_factory=dict)

    @property
    def has_episodes(self) -> bool:
        """Whether the run is a sweep, a rollout or an import."""
        return self.kind in (SWEEP, ROLLOUT, IMPORT)

    @property
    def is_training(self) -> bool:
        """Whether the run is a training, or weights that were imported or copied."""
        return not self.has_episodes and any((self.folder / name).is_file() for name in (LOG, WEIGHTS))


def find_runs(results: str | Path) -> list[RunEntry]:
    """Return every run of the results folder, the newest first."""
    database = Database(results)
    rows: dict[tuple[str, str], RunRow] = {}
    for row in run_rows(database):
        rows.setdefault((row.kind, row.name), row)
    runs = _studies(database, rows)
    kinds = artifact_kinds()
    made = {run.id: run for kind in kinds for run in _artifacts(database.results / "artifacts" / kind, kind)}
    for (kind, name), row in rows.items():
        entry = made.get(f"{kind}/{name}")
        if kind not in (SWEEP, ROLLOUT, IMPORT) and row.status != COMPLETE:
            folder = database.results / ("pretrained" if kind == POLICY else f"artifacts/{kind}") / name
            entry = entry or RunEntry(f"{kind}/{name}", kind, folder, "", "begun", (kind,))
            made[entry.id] = replace(entry, started=row.started[:19], state=state_text(row), command=row.command)
        elif entry is not None and not entry.command:  # demonstrations do not say how they were recorded
            made[entry.id] = replace(entry, command=row.command)
    return sorted([*runs, *made.values()], key=lambda run: (run.started, run.id), reverse=True)


def state_text(row: RunRow) -> str:
    """Return a begun command's state in words: `running, 300 of 600`."""
    return f"{row.status}, {row.done} of {row.total}" if row.total else row.status


def find_run(results: str | Path, name: str, exact: bool = False) -> RunEntry:
    """The run of that id, of a unique part of one, or the newest for `last`. exact: of that id alone.

    Raises:
        UsageError: several runs have that part, or there is no run at all. UnknownName: none has it.
    """
    runs = find_runs(results)
    if not runs:
        raise UsageError(f"no runs in {results}: make one with 'kerv rollout method=spec_vla task=reach'")
    if name == LAST and not exact:
        return runs[0]
    same = [run for run in runs if run.id == name]
    near = same or [run for run in runs if name in run.id and not exact]
    if not near:
        raise UnknownName("run", name, [run.id for run in runs])
    if len(near) > 1:
        raise UsageError(f"'{name}' is a part of {len(near)} runs: {', '.join(run.id for run in near[:5])}")
    return near[0]


_STATES = ("complete", "begun", "damaged", "step ", "running", "interrupted", "failed")
"""How states begin that do not begin with a number."""


def matching(runs: Sequence[RunEntry], filters: dict[str, str]) -> list[RunEntry]:
    """Those runs that agree with every filter: kind, method, task (patterns such as `drawer*` too), state (a beginning
    of it) and since (ISO 8601).

    Raises:
        UnknownName: no such filter, kind or state. UsageError: `since` is no date.
    """
    filter_names = ("kind", "method", "task", "state", "since")
    for key in filters:
        if key not in filter_names:
            raise UnknownName("filter", key, filter_names)
    kinds = (SWEEP, ROLLOUT, IMPORT, POLICY, *artifact_kinds())
    if filters.get("kind", SWEEP) not in kinds:
        raise UnknownName("kind of run", filters["kind"], kinds)
    state = filters.get("state", "")
    if not any(one.startswith(state) or state.startswith(one) for one in _STATES) and not state[:1].isdigit():
        raise UnknownName("state", state, _STATES)
    if "since" in filters and not re.fullmatch(r"\d{4}(-\d\d){0,2}(T.*)?", filters["since"]):
        raise UsageError(f"since={filters['since']} is no date: write 2026-11-23 or 2026-11-23T14:00")
    return [run for run in runs if _agrees(run, filters)]


def _agrees(run: RunEntry, filters: dict[str, str]) -> bool:
    task = filters.get("task", "*")
    return (
        filters.get("kind", run.kind) == run.kind
        and ("method" not in filters or any(fnmatch.fnmatch(name, filters["method"]) for name in run.methods))
        and ("task" not in filters or any(fnmatch.fnmatch(t, task) or t == f"{task}-v3" for t in run.tasks))
        and run.state.startswith(filters.get("state", ""))
        and run.started >= filters.get("since", "")
    )


def store_of(run: RunEntry) -> StudyStore:
    """Return the store of a sweep, a rollout or an import.

    Raises:
        UsageError: It is another kind of run.
    """
    if not run.has_episodes:
        raise UsageError(f"{run.id} is a {run.kind}: it has no episodes")
    return StudyStore(run.folder.parent.parent, run.folder.name, run.kind)


def _studies(database: Database, rows: Mapping[tuple[str, str], RunRow]) -> list[RunEntry]:
    """Return the studies of the database, with what they want and have."""
    count = sa.func.count
    every = WANTED.join(SETTINGS).join(STUDIES).outerjoin(EPISODES, EPISODES.c.id == WANTED.c.episode_id)
    sums = sa.select(
        STUDIES.c.name, count(), count(WANTED.c.episode_id), sa.func.min(EPISODES.c.started),
        sa.func.sum(sa.cast(EPISODES.c.success, sa.Integer)),
    ).select_from(every).group_by(STUDIES.c.name)  # fmt: skip
    tasks: dict[str, list[str]] = {}
    with database.reading() as connection:
        found = {row[0]: row[1:] for row in connection.execute(sums)}
        query = sa.select(STUDIES.c.name, WANTED.c.task).select_from(WANTED.join(SETTINGS).join(STUDIES))
        for name, task in connection.execute(query.group_by(STUDIES.c.name, WANTED.c.task).order_by(WANTED.c.task)):
            tasks.setdefault(name, []).append(task)
        studies = connection.execute(sa.select(STUDIES)).all()
        settings = connection.execute(
            sa.select(SETTINGS.c.study_id, SETTINGS.c.method, SETTINGS.c.identity).order_by(SETTINGS.c.position)
        ).all()
    entries = []
    for study in studies:
        store, row = StudyStore(database, study.name, study.kind), rows.get((study.kind, study.name))
        wanted, there, started, successes = found.get(study.name, (0, 0, None, None))
        state = "complete" if there == wanted else f"{there} of {wanted} episodes"
        state = f"running, {there} of {wanted} episodes" if row is not None and row.status == RUNNING else state
        mine = [one for one in settings if one.study_id == study.id]
        pairs = [pair for one in mine for pair in one.identity.items() if pair[0] != OBSERVATION and pair[1]]
        entries.append(
            RunEntry(
                id=study.name,
                kind=study.kind,
                folder=store.root,
                started=(started or (row.started if row else study.created))[:19],
                state=state,
                methods=tuple(dict.fromkeys(one.method for one in mine)),
                tasks=tuple(tasks.get(study.name, ())),
                episodes=int(there),
                figures={"success": int(successes or 0) / there} if there else {},
                command=row.command if row else (),
                made_from=dict(reversed(pairs)),
            )
        )
    return entries


def description_of(run: RunEntry) -> dict[str, Any]:
    """The provenance of an artifact; empty where it names none, and before a training's first validation.

    Raises:
        CheckpointError: the file is damaged.
    """
    return dict(_described(run.folder, run.kind).get("provenance") or {})


def command_of(run: RunEntry) -> tuple[str, ...]:
    """Words behind `kerv` that make the run: of a sweep or rollout as they were typed, of an artifact its command, with
    the settings that its description names and that are not the command's defaults."""
    name = " ".join(run.command)
    if run.has_episodes or name not in parts("command"):
        return run.command
    schema, described = parts("command")[name].settings, _described(run.folder, run.kind)
    stored = with_artifacts(described["provenance"].get("settings") or described)
    settings = {at.name: stored[at.name] for at in fields(schema) if at.name in stored}
    chosen = [
        f"{group}={value}"
        for group, default in choices_of(schema).items()
        if isinstance(settings.get(group), Mapping)
        for value in settings[group].values()
        if value in groups()[group] and value != default
    ]
    defaults = as_overrides(**asdict(compose(name.replace(" ", "_"), chosen, schema)))
    return *run.command, *chosen, *(word for word in as_overrides(**settings) if word not in defaults)


def _described(folder: Path, kind: str) -> dict[str, Any]:
    path = _description(folder, kind)
    return read_mapping(path) if path.exists() else {}


def _description(folder: Path, kind: str) -> Path:
    """The file that describes an artifact."""
    return folder / ("manifest.json" if kind in ("demos", "datastore") else f"{kind}.json")


def _artifacts(folder: Path, kind: str) -> Iterator[RunEntry]:
    with contextlib.suppress(OSError):
        clean(folder)
    for path in visible(folder):
        # an unfinished recording and a training before its first validation have no description yet
        if any(file.is_file() for file in (_description(path, kind), path / "recording.json", path / LOG)):
            yield _artifact(path, kind)


def state_of(folder: Path, kind: str) -> str:
    """The `state` of the artifact in a folder."""
    return _artifact(folder, kind).state


def _artifact(folder: Path, kind: str) -> RunEntry:
    changed = max((_changed(path) for path in visible(folder) if path.is_file()), default="")
    run = RunEntry(f"{kind}/{folder.name}", kind, folder, changed, "damaged")
    try:
        value = _described(folder, kind)
        provenance = dict(value.get("provenance") or {})
        settings = dict(provenance.get("settings") or {})
        return replace(
            run,
            state=_trained_state(folder, settings) if run.is_training else "complete" if value else "begun",
            methods=(kind,),
            tasks=tuple(settings.get("task") or value.get("tasks") or ()),
            episodes=int(value.get("episodes", 0)) if kind == "demos" else 0,
            figures=_figures(value, provenance),
            command=tuple(str(provenance.get("command", "")).split()[1:]),
            sha256=_hash_of(_description(folder, kind), value),
            made_from=_made_from(value, provenance),
        )
    except (KervError, OSError, ValueError, TypeError, AttributeError, KeyError):
        return run


def _hash_of(path: Path, value: Mapping[str, Any]) -> str:
    """By which others name the artifact: that of its weights or data, else of its description."""
    if value.get("kind") == "datastore":
        return content_of(value["key"], value["chunk"], value["target"], value["files"])
    return str(value.get("sha256") or (sha256_of(path) if value else ""))


def _trained_state(folder: Path, settings: Mapping[str, Any]) -> str:
    if not (folder / LOG).is_file():
        return "complete"  # copied or imported: it has no log
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(folder / LOG))))
    except csv.Error as error:
        raise ValueError(f"{folder / LOG}: {error}") from error
    steps, step = int(settings.get("train", {}).get("steps", 0)), float(rows[-1]["step"]) if rows else 0.0
    return "complete" if step >= steps else f"step {step:.0f} of {steps}"


def _figures(value: Mapping[str, Any], provenance: Mapping[str, Any]) -> dict[str, float]:
    counts = {name: float(value[name]) for name in ("episodes", "rows") if isinstance(value.get(name), int)}
    return counts | {name: float(number) for name, number in dict(provenance.get("validation") or {}).items()}


def _made_from(value: Mapping[str, Any], provenance: Mapping[str, Any]) -> dict[str, str]:
    """Kind -> hash, from wherever an artifact's description names it."""
    hashes = dict(value.get("drafts") or {})  # of a certificate
    for kind, entry in (("target", value.get("target")), ("demos", value.get("demos") or provenance.get("demos"))):
        sha256 = entry.get("sha256") if isinstance(entry, Mapping) else entry
        hashes |= {kind: str(sha256)} if sha256 else {}
    return hashes | ({"init": str(provenance["init"])} if provenance.get("init") else {})


def parents(run: RunEntry, runs: Sequence[RunEntry]) -> dict[str, str]:
    """Kind -> what the run was made from: the id of a run here or a shipped policy, else the first letters of its
    hash."""
    names = {other.sha256: other.id for other in runs if other.sha256}
    for folder in visible(shipped_dir()):
        for kind in artifact_kinds():
            with contextlib.suppress(KervError):
                names.setdefault(str(_described(folder / kind, kind).get("sha256", "")), f"shipped {folder.name}")
    return {kind: names.get(value, value[:12]) for kind, value in run.made_from.items()}


def _changed(path: Path) -> str:
    try:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")[:19]
    except OSError:
        return ""


def disk_bytes(folder: Path) -> int:
    """Size of everything below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def check_removable(run: RunEntry) -> None:
    """Raise UsageError if the folder is a link, or a process makes the run at the moment."""
    if run.folder.is_symlink():
        raise UsageError(f"{run.folder} is a link to {os.readlink(run.folder)}: remove the link, or what it points to")
    if run.state.startswith(RUNNING):
        raise UsageError(f"{run.id} is running: stop it first")


def remove(run: RunEntry, results: str | Path = "") -> None:
    """Remove the run's folder and its rows.

    The folder first gets the name of a temporary, which no command reads and which a later one cleans away. If this
    process is killed before the rows are gone, the run is still listed and can be removed again.

    Args:
        run: What to remove.
        results: Its results folder; by default the one that its own folder lies in.

    Raises:
        StorageError: The disk refused.
    """
    gone = temporary_beside(run.folder)
    if run.folder.exists():
        with storage_errors(run.folder):
            run.folder.rename(gone)
            sync(run.folder.parent)
    if run.has_episodes:
        store_of(run).remove()
    database = Database(results or run.folder.parents[1 if run.has_episodes else 2])
    forget(database, run.kind, run.id if run.has_episodes else run.id.removeprefix(f"{run.kind}/"))
    shutil.rmtree(gone, ignore_errors=True)
