"""Import evaluations that vla-eval ran. They become one study, with one setting per imported path.

A vla-eval recording is a SQLite file. If a kerv server decoded the episodes, their decodes are imported, too
(`read_served`). For episodes of other servers, only success, number of steps and wall time are known.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import pyarrow as pa

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import atomic_path
from kerv_cli.base.settings import read_settings
from kerv_cli.catalogue.imports import connect_foreign
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.identity import ENGINE, OBSERVATION, Setting, flat
from kerv_cli.episodes.rows import DECODE_SCHEMA, EPISODE_SCHEMA, INT, decodes_table, episode_row
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import Database
from kerv_cli.lab.plan import Episode
from kerv_cli.lab.store import IMPORT, ImportedEpisode, Study

HARNESS = "vla-eval"
"""Name of the evaluation program."""
_DAMAGE = (sqlite3.Error, OSError, ValueError, KeyError, TypeError, AttributeError)

_UNKNOWN_DECODE = {"index": 0, "step": 0, "mode": "elsewhere", "forwards": 0, "seconds": math.nan, "tokens": [],
                   "actions": [], "rounds": [], "compensated": 0, "skipped": False}  # fmt: skip
"""Placeholder for the unknown decodes of a server that is not kerv's."""


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode of a recorded evaluation.

    Attributes:
        task: Name of the task.
        index: Number of the episode within the task.
        seed: Seed of the initial state. It equals `index` if the benchmark does not name a seed.
        success: Whether the task was solved.
        steps: Number of control steps.
        seconds: Wall time in seconds.
        id: The episode's id in the evaluation program.
        start: Numbers that describe the initial state.
        reason: The error that ended the episode. Empty if there was none.
    """

    task: str
    index: int
    seed: int
    success: bool
    steps: int
    seconds: float
    id: str
    start: tuple[float, ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class Evaluation:
    """One benchmark of a recorded evaluation.

    Attributes:
        source: File of the recording.
        id: The evaluation's id in the evaluation program.
        benchmark: Name of the benchmark.
        config: Settings of the benchmark.
        server: What the model server said about itself.
        episodes: The recorded episodes.
        planned: Number of episodes in the recording's work queue. 0 if the recording has no queue.
    """

    source: Path
    id: str
    benchmark: str
    config: dict[str, Any]
    server: dict[str, Any]
    episodes: tuple[RecordedEpisode, ...]
    planned: int

    @property
    def facts(self) -> dict[str, Any]:
        """What a kerv server said about itself: settings, hashes, machine (`Policy.facts`). Empty for other servers."""
        return dict(self.server.get("kerv") or {})

    @property
    def name(self) -> str:
        """The decoding method, if kerv served the policy; otherwise the name of the model server."""
        method = self.facts.get("settings", {}).get("method")
        return str(method or self.server.get("model_server") or "server")


def import_evaluations(
    database: Database, paths: Sequence[Path], name: str, labels: Sequence[str], baseline: str, words: Sequence[str]
) -> tuple[str, list[str]]:
    """Import evaluations into the database as one study.

    Args:
        database: The database to write to.
        paths: One path per setting: a vla-eval recording, or a folder of recordings.
        name: Name of the study. If empty, it is made from the names of the benchmarks.
        labels: A label for each path. If empty, the labels are the names of the servers.
        baseline: Label of the baseline. If empty, it is `ar` if there is such a label, or else the first label.
        words: Command-line arguments (without `kerv`) of the import.

    Returns:
        Name of the study, and a list of notes. A note says how many episodes of an evaluation ended in an error, or how
        many are missing.

    Raises:
        UsageError: A path holds no evaluation, the evaluations cannot be compared, a study that was not imported has
            the same name, or the baseline's label does not exist.
        StorageError: The disk is full or not writable.
        CheckpointError: A file is damaged.
    """
    by_label = labelled(list(map(read_evaluations, paths)), labels)
    benchmarks = list(dict.fromkeys(map(attrgetter("benchmark"), itertools.chain(*by_label.values()))))
    name = name or re.sub(r"\W+", "_", "-".join(benchmarks))[:80].strip("_") or "imported"
    stored = Study(database, name)
    if stored.exists and stored.kind != IMPORT:
        raise UsageError(f"study '{name}' exists and was not imported: choose another with name=")
    baseline = baseline or ("ar" if "ar" in by_label else next(iter(by_label)))
    if baseline not in by_label:
        raise UsageError(f"baseline={baseline}: the recordings are of {', '.join(by_label)}")
    settings, episodes, existing, notes = [], [], [], list[str]()
    for label, of_path in by_label.items():
        setting = Setting(label, "", _settings(of_path[0]), _identity(of_path))
        settings.append(setting)
        for one in of_path:
            notes += _notes(label, one)
            for episode, recorded in _episodes(setting, one, len(benchmarks) > 1):
                episodes.append(episode)
                if recorded is not None:
                    existing.append((episode, one, recorded))
    title = f"{HARNESS}: {', '.join(benchmarks)}"
    about = title, baseline, "", "; ".join(notes)
    study = Study(database, name, IMPORT, tuple(settings), tuple(episodes), *about)
    study.add((_imported(database.results, *one) for one in existing), words)
    return name, notes


def read_evaluations(path: Path) -> list[Evaluation]:
    """Read the evaluations in a recording, or in a folder of recordings. All must be from the same model server.

    Raises:
        UsageError: There is no recording, no recording has an episode, or the recordings are from several servers or
            have several evaluations of one benchmark.
        CheckpointError: A file is damaged or incomplete.
    """
    files = sorted(path.glob("[!.]*.sqlite")) if path.is_dir() else [path]
    if not files:
        raise UsageError(f"{path} holds no recording of vla-eval (recording-….sqlite)")
    evaluations: list[Evaluation] = []
    for file in files:
        try:
            with contextlib.closing(connect_foreign(file)) as recording:
                for name, metadata in recording.execute("SELECT eval_id, metadata FROM eval_metadata"):
                    evaluation = _evaluation(recording, file, name, metadata)
                    evaluations += [evaluation] if evaluation.episodes else []
        except _DAMAGE as error:
            why = " ".join(f"{type(error).__name__} {error}".split())[:120]
            raise CheckpointError(f"{file} is damaged, cut short or no recording of vla-eval ({why})") from error
    if not evaluations:
        raise UsageError(f"{path}: the recording holds no episode")
    benchmarks = set(map(attrgetter("benchmark"), evaluations))
    servers = list(map(attrgetter("server"), evaluations))
    if len(benchmarks) < len(evaluations) or servers.count(servers[0]) < len(servers):
        raise UsageError(f"{path} holds several evaluations of a benchmark, or of several servers: name each file")
    return evaluations


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
    episodes = []
    for task, index, metrics, steps, seconds, eid, reason in rows:
        measured, index = dict(json.loads(metrics or "{}")), int(index)
        start = tuple(map(float, measured.get("initial_state") or (index,)))
        task, seed = " ".join(str(task or "unknown").split())[:200], int(measured.get("seed", index))
        result = bool(measured.get("success")), int(steps or 0), float(seconds or 0.0)
        episodes.append(RecordedEpisode(task, index, seed, *result, str(eid or ""), start, str(reason or "")))
    (queued,) = file.execute("SELECT COUNT(*) FROM work_queue WHERE eval_id = ?", (name,)).fetchone()
    return Evaluation(path, name, str(about["benchmark"]), config, server, tuple(episodes), queued)


def labelled(recordings: Sequence[list[Evaluation]], labels: Sequence[str] = ()) -> dict[str, list[Evaluation]]:
    """Label each recording. Every label becomes one setting of the imported study.

    Args:
        recordings: The evaluations in each recording.
        labels: A label for each recording. If empty, the labels are the names of the model servers.

    Returns:
        The evaluations by label.

    Raises:
        UsageError: The number of labels is wrong, two labels are equal, or the recordings have different episodes.
    """
    if labels and (len(labels) != len(recordings) or len(set(labels)) < len(labels)):
        raise UsageError(
            f"labels={','.join(labels)}: write a different one for each of the {len(recordings)} recordings"
        )
    by_label: dict[str, list[Evaluation]] = {}
    for position, evaluations in enumerate(recordings):
        label = name = labels[position] if labels else evaluations[0].name
        numbers = itertools.count(2)
        while label in by_label:
            label = f"{name}-{next(numbers)}"
        by_label[label] = evaluations
    first, *others = by_label
    for other in others:
        _check_same_episodes(f"{first} and {other}", by_label[first], by_label[other])
    return by_label


def _check_same_episodes(names: str, first: Sequence[Evaluation], other: Sequence[Evaluation]) -> None:
    name_of, world_of = attrgetter("benchmark"), attrgetter("task", "seed")
    of_other = dict(zip(map(name_of, other), other, strict=True))
    if of_other.keys().isdisjoint(map(name_of, first)):
        ours, theirs = ", ".join(map(name_of, first)), ", ".join(of_other)
        raise UsageError(f"{names} have different benchmarks: {ours} and {theirs}")
    has_pairs = False
    for a in first:
        b = of_other.get(a.benchmark)
        if b is None:
            continue
        left, right = _conditions(a.config), _conditions(b.config)
        for key in sorted(left.keys() | right.keys()):
            if left.get(key) != right.get(key):
                raise UsageError(
                    f"{names} have different episodes of {a.benchmark}: {key} is {left.get(key)} and {right.get(key)}"
                )
        has_pairs |= not set(map(world_of, a.episodes)).isdisjoint(map(world_of, b.episodes))
    if not has_pairs:
        raise UsageError(f"{names} have no episode in common: neither task nor seed agree")


def _conditions(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return those settings of a benchmark that determine its episodes, with dotted keys."""
    return flat({key: config.get(key) for key in ("benchmark", "mode", "max_steps", "params")})


def _episodes(setting: Setting, one: Evaluation, several: bool) -> Iterator[tuple[Episode, RecordedEpisode | None]]:
    """Yield the planned episodes of an evaluation, each with its recorded result.

    The result is None if the episode is missing or ended in an error.

    Args:
        setting: The setting of the evaluation.
        one: The evaluation.
        several: Whether several benchmarks are imported. If so, each task's name begins with its benchmark's name.
    """
    each = int(one.config.get("episodes_per_task") or 0)
    by_task: dict[str, list[RecordedEpisode]] = {}
    for episode in one.episodes:
        by_task.setdefault(episode.task, []).append(episode)
    for task, episodes in by_task.items():
        good = {e.seed: e for e in sorted(episodes, key=attrgetter("seed")) if not e.reason}
        offset = episodes[0].seed - episodes[0].index if not episodes[0].reason else 0
        name = f"{one.benchmark}: {task}" if several else task
        for seed in dict.fromkeys([*good, *range(offset, offset + each)]):
            yield Episode(setting, name, seed), good.get(seed)


def _notes(label: str, one: Evaluation) -> Iterator[str]:
    reasons = list(filter(None, map(attrgetter("reason"), one.episodes)))
    if reasons:
        why = ", ".join(sorted(set(reasons)))
        yield f"{label}: {len(reasons)} episodes ended in an error ({why}) and are left out"
    missing = one.planned - len(one.episodes)
    if missing > 0:
        yield f"{label}: {missing} of {one.planned} episodes of {one.benchmark} are missing"


def _settings(first: Evaluation) -> dict[str, Any]:
    """Return the rollout settings of the evaluation, as nested plain values.

    A kerv server sends its settings. For any other server, the result is the default settings, with the server's name
    as the method.
    """
    stored = first.facts.get("settings")
    plain = asdict(RolloutSettings()) | {"method": first.name}
    if isinstance(stored, dict):
        plain |= stored
        with contextlib.suppress(KervError):  # a part that is not registered here
            plain = asdict(read_settings(RolloutSettings, stored))
    if str(first.config.get("benchmark", "")).startswith("kerv_cli."):
        params, world = dict(first.config.get("params") or {}), plain["world"]
        world["horizon"] = params.get("horizon", world["horizon"])
        world["stress"]["kind"] = params.get("stress", world["stress"]["kind"])
        world["stress"]["level"] = params.get("stress_level", world["stress"]["level"])
        world["camera"]["name"] = params.get("camera", world["camera"]["name"])
    return plain


def _identity(evaluations: Sequence[Evaluation]) -> dict[str, str]:
    """Return hashes of the weights and of the recorded results.

    The hash of the results keeps rollouts from reusing imported episodes.
    """
    recorded = [[one.id, list(map(astuple, one.episodes))] for one in evaluations]
    digest = hashlib.sha256(json.dumps(recorded, sort_keys=True).encode()).hexdigest()
    identity = {"target": ""}
    for kind, sha256 in dict(evaluations[0].facts.get("identity") or {}).items():
        identity[str(kind)] = str(sha256)
    return identity | {"evaluation": digest, OBSERVATION: "of the benchmark"}


def _imported(results: Path, episode: Episode, one: Evaluation, recorded: RecordedEpisode) -> ImportedEpisode:
    """Return an episode for the database, with its decodes if kerv served it.

    In vla-eval, settings do not take turns. So each evaluation is a block (episodes that one process ran) of its own.

    Args:
        results: The results folder. It holds the episodes that kerv served.
        episode: Setting, task and seed in the study.
        one: The evaluation.
        recorded: The recorded result.
    """
    path = path_of(results, one.id, recorded.id) if one.facts else None
    served = read_served(path) if path is not None else None
    row: dict[str, Any] = {"success": recorded.success, "steps": recorded.steps}
    row |= {"initial_state": list(recorded.start), "wall_seconds": recorded.seconds}
    if served is not None:
        stored, decodes = served
        row = {name: stored.get(name) for name in (*EPISODE_SCHEMA.names, "started")} | row
    else:
        row = {column.name: 0 for column in EPISODE_SCHEMA if column.type == INT} | {"decodes": 1} | row
        decodes = pa.Table.from_pylist([_UNKNOWN_DECODE], schema=DECODE_SCHEMA)
    about = {
        "device_name": "",
        **dict(one.facts.get("machine") or {}),
        "workers": 1,
        "executor": HARNESS,
        "engine": ENGINE,
        "server": one.server.get("model_server", ""),
        "harness_version": one.server.get("harness_version", ""),
        "imported": {"source": one.source.name, "evaluation": one.id, "config": one.config},
    }
    return ImportedEpisode(episode, row, decodes, f"{one.id} {episode.setting.label}", about)


SERVED = "served"
_KEY = b"kerv"
_NAME = re.compile(r"\w[\w.-]{0,199}")


def path_of(results: Path, evaluation: str, episode: str) -> Path | None:
    """Return the file in which a kerv server stores an episode that it decoded.

    None if the name of the evaluation or episode cannot be used as a file name.
    """
    if not _NAME.fullmatch(evaluation) or not _NAME.fullmatch(episode):
        return None
    return results / SERVED / evaluation / f"{episode}.arrow"


def write_served(path: Path, record: EpisodeRecord, started: str, by: Mapping[str, Any]) -> None:
    """Write one episode, which a kerv server decoded, to a file.

    Args:
        path: The file.
        record: The episode. If the positions of the end effector are unknown, `record.path` has the shape (0, 3).
        started: Time at which the episode began (ISO 8601).
        by: Facts about the server (`Policy.facts`).

    Raises:
        StorageError: The disk is full or not writable.
    """
    row = episode_row(record) | {"task": record.task, "seed": record.seed, "started": started}
    if not len(record.path):
        row |= {"path_length": None, "jerk": None}
    facts = json.dumps({"episode": row, "by": by})
    table = decodes_table(record).replace_schema_metadata({_KEY: facts})
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    with atomic_path(path) as temporary, pa.ipc.new_file(str(temporary), table.schema, options=options) as file:
        file.write_table(table)


def read_served(path: Path) -> tuple[dict[str, Any], pa.Table] | None:
    """Read an episode that `write_served` wrote.

    Returns:
        The episode's columns, and the table of its decodes. None if the file does not exist.

    Raises:
        CheckpointError: The file is damaged.
    """
    try:
        with pa.ipc.open_file(str(path)) as file:
            table = file.read_all()
        facts = json.loads((table.schema.metadata or {})[_KEY])
        table = table.replace_schema_metadata(None)
        return facts["episode"], table.select(DECODE_SCHEMA.names).cast(DECODE_SCHEMA)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise CheckpointError(f"{path} is damaged ({' '.join(str(error).split())[:80]}): move it aside") from error
