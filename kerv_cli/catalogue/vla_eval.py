"""Imports evaluations that vla-eval ran, as a study with a setting per model server.

A recording is a SQLite file. For servers of kerv the decodes are known too (served.py). For other servers success and
steps are known, but no times.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import visible
from kerv_cli.catalogue.served import path_of, read_served
from kerv_cli.catalogue.sqlite import connect_foreign
from kerv_cli.episodes.identity import ENGINE, OBSERVATION
from kerv_cli.episodes.rows import DECODE_SCHEMA, EPISODE_SCHEMA, INT
from kerv_cli.episodes.settings import RolloutSettings, settings_from
from kerv_cli.lab.plan import Episode, Setting, Study
from kerv_cli.lab.store import IMPORT, ImportedEpisode, StudyStore

_UNKNOWN_DECODE = {"index": 0, "step": 0, "mode": "elsewhere", "forwards": 0, "seconds": math.nan, "tokens": [],
                   "actions": [], "rounds": [], "compensated": 0, "skipped": False}  # fmt: skip
"""Stands for all decodes of a server that is not kerv's."""


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode of a recording.

    Attributes:
        task: Name of the task.
        index: Number of the episode within the task.
        seed: Seed of its initial state if the benchmark names it, else the index.
        success: Whether the task was solved.
        steps: Number of control steps. None: unknown.
        seconds: Wall time.
        id: The harness's name for it.
        start: Initial state.
        reason: Why it ended in an error. Empty: it did not.
    """

    task: str
    index: int
    seed: int
    success: bool
    steps: int | None
    seconds: float
    id: str
    start: tuple[float, ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class Evaluation:
    """One benchmark of a recording.

    Attributes:
        source: The file.
        id: The harness's name for it.
        benchmark: Name of the benchmark.
        config: Settings of the benchmark.
        server: What the model server said about itself.
        episodes: Its episodes.
        planned: Number of episodes that were planned, as far as the recording says.
        harness: The program that ran it.
    """

    source: Path
    id: str
    benchmark: str
    config: dict[str, Any]
    server: dict[str, Any]
    episodes: tuple[RecordedEpisode, ...]
    planned: int
    harness: str = "vla-eval"

    @property
    def facts(self) -> dict[str, Any]:
        """`Policy.facts` of a server of kerv. Empty for other servers."""
        return dict(self.server.get("kerv") or {})

    @property
    def name(self) -> str:
        """Method of a server of kerv, else the name of the server."""
        method = self.facts.get("settings", {}).get("method")
        return str(method or self.server.get("model_server") or "server")


def read_evaluations(path: Path) -> list[Evaluation]:
    """Return the evaluations in a recording of vla-eval, or in all recordings of a folder.

    Raises:
        UsageError: There is no recording, or none has an episode.
        CheckpointError: A recording is damaged or cut short.
    """
    files = [file for file in visible(path) if file.suffix == ".sqlite"] if path.is_dir() else [path]
    if not files or not all(file.is_file() for file in files):
        raise UsageError(f"{path}: no recording of vla-eval, recording-….sqlite")
    evaluations = [one for file in files for one in _read(file) if one.episodes]
    if not evaluations:
        raise UsageError(f"{path}: the recording holds no episode")
    return evaluations


def _read(path: Path) -> list[Evaluation]:
    try:
        with contextlib.closing(connect_foreign(path)) as file:
            return [
                _evaluation(file, path, *row) for row in file.execute("SELECT eval_id, metadata FROM eval_metadata")
            ]
    except (sqlite3.Error, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = " ".join(f"{type(error).__name__} {error}".split())[:120]
        raise CheckpointError(f"{path} is damaged, cut short or no recording of vla-eval ({why})") from error


def _evaluation(file: sqlite3.Connection, path: Path, name: str, metadata: str) -> Evaluation:
    about = json.loads(metadata)
    config, server = dict(about.get("config") or {}), dict(about.get("server_info") or {})
    # the last result of an episode that ran again counts
    rows = file.execute(
        "SELECT task_name, episode_id, metrics, steps, elapsed_sec, eid, failure_reason FROM episode_results "
        "WHERE rowid IN (SELECT MAX(rowid) FROM episode_results WHERE eval_id = ? GROUP BY task_name, episode_id) "
        "ORDER BY rowid",
        (name,),
    )
    episodes = tuple(_episode(*row) for row in rows)
    (queued,) = file.execute("SELECT COUNT(*) FROM work_queue WHERE eval_id = ?", (name,)).fetchone()
    return Evaluation(path, name, str(about["benchmark"]), config, server, episodes, queued)


def _episode(
    task: Any, episode_id: Any, metrics: Any, steps: Any, seconds: Any, eid: Any, reason: Any
) -> RecordedEpisode:
    measured, index = dict(json.loads(metrics or "{}")), int(episode_id)
    return RecordedEpisode(
        task=" ".join(str(task or "unknown").split())[:200],
        index=index,
        seed=int(measured.get("seed", index)),
        success=bool(measured.get("success")),
        steps=int(steps or 0),
        seconds=float(seconds or 0.0),
        id=str(eid or ""),
        start=tuple(float(x) for x in measured.get("initial_state") or (index,)),
        reason=str(reason or ""),
    )


@dataclass
class Server:
    """The evaluations of one model server, which are one setting of the study."""

    label: str
    evaluations: list[Evaluation]


def by_server(recordings: Sequence[Sequence[Evaluation]], labels: Sequence[str] = ()) -> list[Server]:
    """Group evaluations by their model server.

    Args:
        recordings: The evaluations of each recording.
        labels: A label for each recording. Empty: names of the servers.

    Raises:
        UsageError: The number of labels is wrong, or the evaluations have different episodes.
    """
    if labels and (len(labels) != len(recordings) or len(set(labels)) < len(labels)):
        raise UsageError(
            f"labels={','.join(labels)}: write a different one for each of the {len(recordings)} recordings"
        )
    servers: list[Server] = []
    for number, evaluations in enumerate(recordings):
        for one in evaluations:
            name = labels[number] if labels else one.name
            for server in servers:
                first, benchmarks = server.evaluations[0], {other.benchmark for other in server.evaluations}
                is_same = first.server == one.server and one.benchmark not in benchmarks
                if server.label == name if labels else is_same:
                    server.evaluations.append(one)
                    break
            else:
                taken = {server.label for server in servers}
                label = next(n for n in (name, *(f"{name}-{i}" for i in range(2, 10_000))) if n not in taken)
                servers.append(Server(label, [one]))
    for server in servers[1:]:
        _check_same_episodes(servers[0], server)
    return servers


def _check_same_episodes(first: Server, other: Server) -> None:
    pairs = [(a, b) for a in first.evaluations for b in other.evaluations if a.benchmark == b.benchmark]
    if not pairs:
        names = (", ".join(one.benchmark for one in server.evaluations) for server in (first, other))
        raise UsageError(f"{first.label} and {other.label} have different benchmarks: {' and '.join(names)}")
    for a, b in pairs:
        left, right = _conditions(a.config), _conditions(b.config)
        for key in sorted(left.keys() | right.keys()):
            if left.get(key) != right.get(key):
                raise UsageError(
                    f"{first.label} and {other.label} have different episodes of {a.benchmark}: {key} is "
                    f"{left.get(key)} and {right.get(key)}"
                )
    if not any(
        {(one.task, one.seed) for one in a.episodes} & {(one.task, one.seed) for one in b.episodes} for a, b in pairs
    ):
        raise UsageError(f"{first.label} and {other.label} have no episode in common: neither task nor seed agree")


def _conditions(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a benchmark that determine its world."""
    params = {f"params.{key}": value for key, value in dict(config.get("params") or {}).items()}
    return {key: config.get(key) for key in ("benchmark", "mode", "max_steps")} | params


def write_study(results: Path, name: str, servers: Sequence[Server], baseline: str, words: Sequence[str]) -> list[str]:
    """Write the evaluations of these servers as a study.

    Args:
        results: The results folder.
        name: Name of the study.
        servers: A setting each.
        baseline: Label of the baseline. Empty: ar, else the first.
        words: Words after `kerv` of the command.

    Returns:
        Lines about missing episodes.

    Raises:
        UsageError: Another study has the name, or there is no such label.
        StorageError: The disk refused.
        CheckpointError: A served episode is damaged.
    """
    store = StudyStore(results, name)
    if store.exists and store.kind != IMPORT:
        raise UsageError(f"study '{name}' exists and was not imported: choose another with name=")
    labels = [server.label for server in servers]
    baseline = baseline or ("ar" if "ar" in labels else labels[0])
    if baseline not in labels:
        raise UsageError(f"baseline={baseline}: the recordings are of {', '.join(labels)}")
    evaluations = [(server, one) for server in servers for one in server.evaluations]
    benchmarks = list(dict.fromkeys(one.benchmark for _, one in evaluations))
    settings = {server.label: Setting(server.label, "", _settings(server), _identity(server)) for server in servers}
    episodes = {
        episode: (one, recorded)
        for server, one in evaluations
        for episode, recorded in _episodes(settings[server.label], one, len(benchmarks) > 1)
    }
    notes = [line for server, one in evaluations for line in _notes(server.label, one)]
    title = f"{', '.join(dict.fromkeys(one.harness for _, one in evaluations))}: {', '.join(benchmarks)}"
    study = Study(name, tuple(settings.values()), tuple(episodes), IMPORT, title, baseline, note="; ".join(notes))
    existing = (
        _imported(results, episode, one, recorded)
        for episode, (one, recorded) in episodes.items()
        if recorded is not None
    )
    StudyStore(results, name, IMPORT).add(study, existing, words)
    return notes


def _episodes(
    setting: Setting, one: Evaluation, names_benchmark: bool
) -> Iterator[tuple[Episode, RecordedEpisode | None]]:
    """Yield the episodes of an evaluation. None: it is missing or ended in an error."""
    each = int(one.config.get("episodes_per_task") or 0)
    for task in dict.fromkeys(episode.task for episode in one.episodes):
        episodes = [episode for episode in one.episodes if episode.task == task]
        good = {e.seed: e for e in sorted(episodes, key=lambda e: e.seed) if not e.reason}
        offset = episodes[0].seed - episodes[0].index if not episodes[0].reason else 0
        name = f"{one.benchmark}: {task}" if names_benchmark else task
        for seed in dict.fromkeys([*good, *(i + offset for i in range(each))]):
            yield Episode(setting, name, seed), good.get(seed)


def _notes(label: str, one: Evaluation) -> Iterator[str]:
    reasons = [episode.reason for episode in one.episodes if episode.reason]
    if reasons:
        why = ", ".join(sorted(set(reasons)))
        yield f"{label}: {len(reasons)} episodes ended in an error ({why}) and are left out"
    missing = one.planned - len(one.episodes)
    if missing > 0:
        yield f"{label}: {missing} of {one.planned} episodes of {one.benchmark} are missing"


def _settings(server: Server) -> dict[str, Any]:
    """Return RolloutSettings that say what ran: those of a server of kerv, else defaults with the server's name."""
    first = server.evaluations[0]
    stored = first.facts.get("settings")
    plain = dataclasses.asdict(RolloutSettings()) | {"method": first.name}
    if isinstance(stored, dict):
        plain |= stored
        with contextlib.suppress(KervError):  # a part that is not registered here
            plain = dataclasses.asdict(settings_from(stored))
    if str(first.config.get("benchmark", "")).startswith("kerv_cli."):
        params, world = dict(first.config.get("params") or {}), plain["world"]
        world["horizon"] = params.get("horizon", world["horizon"])
        world["stress"]["kind"] = params.get("stress", world["stress"]["kind"])
        world["stress"]["level"] = params.get("stress_level", world["stress"]["level"])
        world["camera"]["name"] = params.get("camera", world["camera"]["name"])
    return plain


def _identity(server: Server) -> dict[str, str]:
    """Return hashes of the weights, and of what was recorded: a rollout never reuses an imported episode."""
    recorded = [[one.id, [dataclasses.astuple(e) for e in one.episodes]] for one in server.evaluations]
    digest = hashlib.sha256(json.dumps(recorded, sort_keys=True).encode()).hexdigest()
    hashes = {str(k): str(v) for k, v in dict(server.evaluations[0].facts.get("identity") or {}).items()}
    return {"target": "", **hashes, "evaluation": digest, OBSERVATION: "of the benchmark"}


def _imported(results: Path, episode: Episode, one: Evaluation, recorded: RecordedEpisode) -> ImportedEpisode:
    """Return an episode for the database, with its decodes if kerv served it.

    The evaluations did not take turns, so each is a block of its own.
    """
    path = path_of(results, one.id, recorded.id) if one.facts else None
    served = read_served(path) if path is not None else None
    row: dict[str, Any] = {"success": recorded.success, "steps": recorded.steps}
    row |= {"initial_state": list(recorded.start), "wall_seconds": recorded.seconds}
    if served is not None:
        row = {name: served.episode.get(name) for name in (*EPISODE_SCHEMA.names, "started")} | row
        decodes = served.decodes
    else:
        row = {column.name: 0 for column in EPISODE_SCHEMA if column.type == INT} | {"decodes": 1} | row
        decodes = pa.Table.from_pylist([_UNKNOWN_DECODE], schema=DECODE_SCHEMA)
    about = {
        "device_name": "",
        **dict(one.facts.get("machine") or {}),
        "workers": 1,
        "executor": one.harness,
        "engine": ENGINE,
        "server": one.server.get("model_server", ""),
        "harness_version": one.server.get("harness_version", ""),
        "imported": {"source": one.source.name, "evaluation": one.id, "config": one.config},
    }
    return ImportedEpisode(episode, row, decodes, f"{one.id} {episode.setting.label}", about)


def study_name(servers: Sequence[Server]) -> str:
    """Return a name for the study: that of its benchmarks."""
    names = dict.fromkeys(one.benchmark for server in servers for one in server.evaluations)
    return re.sub(r"\W+", "_", "-".join(names))[:80].strip("_") or "imported"
