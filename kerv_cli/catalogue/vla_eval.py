"""Evaluations that vla-eval ran, as a study: a setting per server, whose episodes reports pair.

A recording is a SQLite file or the aggregate JSON beside it. What kerv served has kerv's decodes too (served.py); of
other servers success and steps are known, and nothing of their time.
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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import read_json, visible
from kerv_cli.base.foreign import foreign_sqlite
from kerv_cli.base.spaces import ActionSpace, Group
from kerv_cli.catalogue.served import Served, path_of, read_served
from kerv_cli.engine.record import UNTIMED, DecodeRecord, EpisodeRecord
from kerv_cli.episodes.identity import ENGINE, OBSERVATION
from kerv_cli.episodes.rows import EPISODE_SCHEMA, decodes_table, episode_row
from kerv_cli.episodes.settings import RolloutSettings, settings_from
from kerv_cli.lab.plan import Setting, Study, Wanted
from kerv_cli.lab.store import IMPORT, Foreign, StudyStore

_ELSEWHERE = "elsewhere"
"""Mode of the one decode that stands for those of a server which is not kerv."""
_UNKNOWN = ("path_length", "jerk")
"""Columns of an episode of another server."""
_ONE = ActionSpace(("x",), (Group("x", 1),), (), 1.0, (-1.0,), (1.0,))
_WORLD = {"horizon": "horizon", "stress": "stress.kind", "stress_level": "stress.level", "camera": "camera.name"}
"""Parameter of kerv's own benchmark -> the setting of the world that it is."""


@dataclass(frozen=True)
class Episode:
    """One recorded episode. seed: its initial state's where the benchmark names it, else its index. reason: why it
    ended in an error, empty where it did not."""

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
    """One benchmark of a recording. id: the harness's name of it. config: of the benchmark. server: what the model
    server said of itself. planned: episodes, as far as the recording tells. harness: the program that ran it."""

    source: Path
    id: str
    benchmark: str
    config: dict[str, Any]
    server: dict[str, Any]
    episodes: tuple[Episode, ...]
    planned: int
    harness: str = "vla-eval"

    @property
    def facts(self) -> dict[str, Any]:
        """`Policy.facts` of kerv's server; empty where another one served."""
        return dict(self.server.get("kerv") or {})

    @property
    def name(self) -> str:
        """Its method where kerv served, else its server."""
        method = self.facts.get("settings", {}).get("method")
        return str(method or self.server.get("model_server") or "server")


def read_evaluations(path: Path) -> list[Evaluation]:
    """The evaluations in a recording of vla-eval or a file of lerobot-eval, or in all of a folder.

    Raises:
        UsageError: nothing is there. CheckpointError: a recording is damaged or cut short.
    """
    files = [path]
    if path.is_dir():
        recordings = [file for file in visible(path) if file.suffix in (".sqlite", ".json")]
        files = [f for f in recordings if f.suffix == ".sqlite"]
        files = files or [f for f in recordings if f.name.endswith("_aggregate.json")]
    if not files or not all(file.is_file() for file in files):
        raise UsageError(f"{path}: no recording of vla-eval, recording-….sqlite or …_aggregate.json")
    evaluations = [one for file in files for one in (_from_json if file.suffix == ".json" else _from_sqlite)(file)]
    if not any(one.episodes for one in evaluations):
        raise UsageError(f"{path}: the recording holds no episode")
    return [one for one in evaluations if one.episodes]


def _from_sqlite(path: Path) -> list[Evaluation]:
    with _damage(path), foreign_sqlite(path) as file:
        return [_of_row(file, path, *row) for row in file.execute("SELECT eval_id, metadata FROM eval_metadata")]


def _of_row(file: sqlite3.Connection, path: Path, name: str, metadata: str) -> Evaluation:
    about = json.loads(metadata)
    columns = ("task_name", "episode_id", "metrics", "steps", "elapsed_sec", "eid", "context", "failure_reason")
    # of an episode that ran again the last result counts
    rows = file.execute(
        f"SELECT {', '.join(columns)} FROM episode_results WHERE rowid IN (SELECT MAX(rowid) FROM episode_results "
        "WHERE eval_id = ? GROUP BY task_name, episode_id) ORDER BY rowid",
        (name,),
    )
    episodes = []
    for row in rows:
        one = dict(zip(columns, row, strict=True))
        episodes.append(_episode(one["task_name"], one | {"metrics": json.loads(one["metrics"] or "{}")}))
    queued = file.execute("SELECT COUNT(*) FROM work_queue WHERE eval_id = ?", (name,)).fetchone()[0]
    return _evaluation(path, name, about, episodes, queued)


def _from_json(path: Path) -> list[Evaluation]:
    with _damage(path):
        about = read_json(path)
        episodes = [_episode(task["task"], one) for task in about["tasks"] for one in task["episodes"]]
        return [_evaluation(path, str(about.get("eval_id", path.stem)), about, episodes, 0)]


def _evaluation(
    path: Path, name: str, about: Mapping[str, Any], episodes: Sequence[Episode], queued: int
) -> Evaluation:
    config, server = dict(about.get("config") or {}), dict(about.get("server_info") or {})
    each = int(config.get("episodes_per_task") or 0)
    planned = queued or each * len({one.task for one in episodes})
    return Evaluation(path, name, str(about["benchmark"]), config, server, tuple(episodes), planned)


def _episode(task: Any, one: Mapping[str, Any]) -> Episode:
    metrics, index = dict(one.get("metrics") or {}), int(one["episode_id"])
    return Episode(
        task=" ".join(str(task or "unknown").split())[:200],
        index=index,
        seed=int(metrics.get("seed", index)),
        success=bool(metrics.get("success")),
        steps=int(one.get("steps") or 0),
        seconds=float(one.get("elapsed_sec") or 0.0),
        id=str(one.get("eid", "")),
        start=tuple(float(x) for x in metrics.get("initial_state") or (index,)),
        reason=str(one.get("failure_reason") or ""),
    )


@contextlib.contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except (sqlite3.Error, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = " ".join(f"{type(error).__name__} {error}".split())[:120]
        raise CheckpointError(f"{path} is damaged, cut short or no recording of vla-eval ({why})") from error


@dataclass
class Side:
    """A setting of the study: the evaluations of one server."""

    label: str
    evaluations: list[Evaluation] = field(default_factory=list)

    def takes(self, one: Evaluation) -> bool:
        """Whether an evaluation of another benchmark is of the same server."""
        servers = [(each.name, each.facts, each.server.get("action_spec")) for each in (self.evaluations[0], one)]
        return servers[0] == servers[1] and one.benchmark not in {other.benchmark for other in self.evaluations}


def sides_of(recordings: Sequence[Sequence[Evaluation]], labels: Sequence[str] = ()) -> list[Side]:
    """A side per server. recordings: the evaluations of each that was named. labels: of each recording.

    Raises:
        UsageError: another number of labels, or evaluations of other episodes.
    """
    if labels and (len(labels) != len(recordings) or len(set(labels)) < len(labels)):
        raise UsageError(f"labels={','.join(labels)}: one for each of the {len(recordings)} recordings is wanted")
    sides: list[Side] = []
    for number, evaluations in enumerate(recordings):
        for one in evaluations:
            name = labels[number] if labels else one.name
            side = next((s for s in sides if (s.label == name if labels else s.takes(one))), None)
            if side is None:
                taken = {other.label for other in sides}
                free = (label for label in (name, *(f"{name}-{n}" for n in range(2, 10_000))) if label not in taken)
                sides.append(side := Side(next(free)))
            side.evaluations.append(one)
    for side in sides[1:]:
        _check_same_episodes(sides[0], side)
    return sides


def _check_same_episodes(first: Side, other: Side) -> None:
    by_name = {one.benchmark: one for one in first.evaluations}
    shared = [(by_name[one.benchmark], one) for one in other.evaluations if one.benchmark in by_name]
    if not shared:
        names = (", ".join(one.benchmark for one in side.evaluations) for side in (first, other))
        raise UsageError(f"{first.label} and {other.label} are of other benchmarks: {' and '.join(names)}")
    for a, b in shared:
        left, right = _conditions(a.config), _conditions(b.config)
        for key in sorted(left.keys() | right.keys()):
            if left.get(key) != right.get(key):
                raise UsageError(
                    f"{first.label} and {other.label} are of other episodes of {a.benchmark}: {key} is "
                    f"{left.get(key)} and {right.get(key)}"
                )
    episodes = [{(a.benchmark, one.task, one.seed) for one in a.episodes} for a, _ in shared]
    if not set().union(*episodes) & {(b.benchmark, one.task, one.seed) for _, b in shared for one in b.episodes}:
        raise UsageError(f"{first.label} and {other.label} have no episode in common: neither task nor seed agree")


def _conditions(config: Mapping[str, Any]) -> dict[str, Any]:
    """What decides which world an evaluation ran in."""
    params = {f"params.{key}": value for key, value in dict(config.get("params") or {}).items()}
    return {key: config.get(key) for key in ("benchmark", "mode", "max_steps")} | params


def write_study(results: Path, name: str, sides: Sequence[Side], baseline: str, words: Sequence[str]) -> list[str]:
    """Write the study of these sides -> lines about what is missing.

    Args:
        results: The results folder.
        name: Of the study.
        sides: A setting each.
        baseline: Its label; empty: ar, else the first.
        words: The command, after `kerv`.

    Raises:
        UsageError: A study of that name is there that was not imported, or no such label. StorageError: The disk
            refused. CheckpointError: A served episode is damaged.
    """
    store = StudyStore(results, name)
    if store.is_there and store.kind != IMPORT:
        raise UsageError(f"study '{name}' is there and was not imported: choose another with name=")
    labels = [side.label for side in sides]
    baseline = baseline or ("ar" if "ar" in labels else labels[0])
    if baseline not in labels:
        raise UsageError(f"baseline={baseline}: the recordings are of {', '.join(labels)}")
    benchmarks = list(dict.fromkeys(one.benchmark for side in sides for one in side.evaluations))
    settings = {side.label: Setting(side.label, "", _settings(side), _identity(side)) for side in sides}
    planned = [one for side in sides for one in _planned(side, settings[side.label], len(benchmarks) > 1)]
    notes = [line for side in sides for one in side.evaluations for line in _notes(side.label, one)]
    harnesses = dict.fromkeys(one.harness for side in sides for one in side.evaluations)
    title = f"{', '.join(harnesses)}: {', '.join(benchmarks)}"
    wanted = tuple(one for one, _, _ in planned)
    study = Study(name, tuple(settings.values()), wanted, IMPORT, title, baseline, note="; ".join(notes))
    foreign = (
        _foreign(want, one, episode, _served(results, one, episode))
        for want, one, episode in planned
        if episode is not None
    )
    StudyStore(results, name, IMPORT).add(study, foreign, words)
    return notes


def _planned(side: Side, setting: Setting, several: bool) -> Iterator[tuple[Wanted, Evaluation, Episode | None]]:
    """Yield what the side wants, each with its episode; without one, it is missing.

    several: the study is of several benchmarks.
    """
    for one in side.evaluations:
        tasks: dict[str, list[Episode]] = {}
        for episode in one.episodes:
            tasks.setdefault(episode.task, []).append(episode)
        each = int(one.config.get("episodes_per_task") or 0)
        for task, episodes in tasks.items():
            good = {e.seed: e for e in sorted(episodes, key=lambda e: e.seed) if not e.reason}
            offset = episodes[0].seed - episodes[0].index if not episodes[0].reason else 0
            name = f"{one.benchmark}: {task}" if several else task
            for seed in dict.fromkeys([*good, *(i + offset for i in range(each))]):
                yield Wanted(setting, name, seed), one, good.get(seed)


def _notes(label: str, one: Evaluation) -> Iterator[str]:
    """Lines about episodes that failed or are missing."""
    failed = [episode for episode in one.episodes if episode.reason]
    if failed:
        reasons = ", ".join(sorted({episode.reason for episode in failed}))
        yield f"{label}: {len(failed)} episodes ended in an error ({reasons}) and are left out"
    lost = one.planned - len(one.episodes)
    if lost > 0:
        yield f"{label}: {lost} of {one.planned} episodes of {one.benchmark} are missing"


def _served(results: Path, one: Evaluation, episode: Episode) -> Served | None:
    path = path_of(results, one.id, episode.id) if one.facts else None
    return read_served(path) if path is not None else None


def _about(one: Evaluation) -> dict[str, Any]:
    """Return the provenance of an evaluation's episodes."""
    return {
        "device_name": "",
        **dict(one.facts.get("machine") or {}),
        "workers": 1,
        "executor": one.harness,
        "engine": ENGINE,
        "server": one.server.get("model_server", ""),
        "harness_version": one.server.get("harness_version", ""),
        "imported": {"source": one.source.name, "evaluation": one.id, "config": one.config},
    }


def _settings(side: Side) -> dict[str, Any]:
    """Plain settings of a rollout that say what ran: those of kerv's server, else defaults with the server's name."""
    first = side.evaluations[0]
    stored = first.facts.get("settings")
    plain = dataclasses.asdict(RolloutSettings()) | {"method": first.name}
    if isinstance(stored, dict):
        try:
            plain = dataclasses.asdict(settings_from(stored))
        except KervError:  # a part that is not registered here
            plain |= stored
    if str(first.config.get("benchmark", "")).startswith("kerv_cli."):
        params = dict(first.config.get("params") or {})
        for name, key in _WORLD.items():
            at, last = plain["world"], key.split(".")
            for part in last[:-1]:
                at = at[part]
            at[last[-1]] = params.get(name, at[last[-1]])
    return dict(plain)


def _identity(side: Side) -> dict[str, str]:
    """Hashes of the weights where kerv served, and of what was recorded: no rollout means the same."""
    recorded = [[one.id, [dataclasses.astuple(e) for e in one.episodes]] for one in side.evaluations]
    digest = hashlib.sha256(json.dumps(recorded, sort_keys=True).encode()).hexdigest()
    hashes = {str(k): str(v) for k, v in dict(side.evaluations[0].facts.get("identity") or {}).items()}
    return {"target": "", **hashes, "evaluation": digest, OBSERVATION: "of the benchmark"}


def _foreign(wanted: Wanted, one: Evaluation, episode: Episode, served: Served | None) -> Foreign:
    """Return an episode for the database.

    Success and steps are the harness's. Its evaluations did not take turns, so each is a block of its own.
    """
    if served is None:
        record = _bare(wanted, episode)
        row, decodes = episode_row(record) | dict.fromkeys(_UNKNOWN), decodes_table(record)
    else:
        names = (*EPISODE_SCHEMA.names, "started")
        row, decodes = {name: served.episode.get(name) for name in names}, served.decodes
    here: dict[str, Any] = {"success": episode.success, "steps": episode.steps}
    here |= {"initial_state": list(episode.start), "wall_seconds": episode.seconds}
    return Foreign(wanted, row | here, decodes, f"{one.id} {wanted.setting.label}", _about(one))


def _bare(wanted: Wanted, episode: Episode) -> EpisodeRecord:
    """An episode of which no decode is known."""
    decode = DecodeRecord((), np.zeros((0, 1), np.float32), 0, (), _ELSEWHERE, math.nan, dict(UNTIMED))
    nothing = np.zeros((0, 1), np.float32)
    return EpisodeRecord(
        *("none", _ONE, wanted.task, "", episode.seed, episode.success, episode.steps or 0, (decode,), (0,)),
        *(nothing, np.zeros((1, 3), np.float32), np.ones(1, np.float32), np.zeros(0)),
    )


def study_name(sides: Sequence[Side]) -> str:
    """The study's name where none is given: that of the benchmarks."""
    names = dict.fromkeys(one.benchmark for side in sides for one in side.evaluations)
    return re.sub(r"\W+", "_", "-".join(names))[:80].strip("_") or "imported"
