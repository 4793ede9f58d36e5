"""Two runs side by side: which settings differ, and by how much their results do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.catalogue.entries import RunEntry, description_of, find_run, store_of
from kerv_cli.episodes.identity import NOT_DETERMINING, OBSERVATION, without
from kerv_cli.lab.plan import seeds_text
from kerv_cli.report.measures import MICRO, Row, measure
from kerv_cli.report.summary import SPEEDS
from kerv_cli.report.tables import StudyData, flatten, is_number, load_study

_MEASURES = ("AL", "forwards_per_step", "time_per_step_ms", "skip_rate", "unverified_share")
_STATUS_KEYS = ("host", "device_name", "git_commit", "torch_version", "mujoco_version", "kerv_version")


@dataclass(frozen=True)
class Side:
    """One side of a comparison: a run, and one of its settings unless it is a training. data: of the run's episodes,
    read by `pairs_to_compare`."""

    name: str
    run: RunEntry
    label: str = ""
    data: StudyData | None = None


@dataclass(frozen=True)
class Difference:
    """A setting, weight, machine or version in which the two sides differ. `None`: that side lacks it."""

    key: str
    first: object
    second: object


@dataclass(frozen=True)
class Comparison:
    """The comparison of two sides. first, second: their names. settings: their differences. results: a row per measure
    with both values, their difference or ratio, and its 95 % interval where there is one."""

    first: str
    second: str
    settings: list[Difference]
    results: list[Row]


def sides(results: str, name: str) -> list[Side]:
    """The sides that a name stands for: `ID` is every setting of a run, `ID:LABEL` one of them.

    Raises:
        UsageError, UnknownName: no such run or setting.
    """
    identifier, _, label = name.partition(":")
    run = find_run(results, identifier)
    if not run.has_episodes:
        if label:
            raise UsageError(f"{run.id} is a {run.kind}: it has no setting '{label}'")
        return [Side(run.id, run)]
    labels = store_of(run).load().labels
    if label and label not in labels:
        raise UsageError(f"run {run.id} has no setting '{label}': it has {', '.join(labels)}")
    many = len(labels) > 1
    settings = [label] if label else labels
    return [Side(f"{run.id}:{setting}" if many else run.id, run, setting) for setting in settings]


def pairs_to_compare(results: str, first: str, second: str) -> list[tuple[Side, Side]]:
    """Pairs of the settings that both runs have; if they share none, the first run's first setting with each of the
    second run's.

    Raises:
        UsageError, UnknownName: no such run or setting. UsageError: a training beside a run with episodes, or a run
            without episodes. CheckpointError: a damaged one.
    """
    ours, theirs = sides(results, first), sides(results, second)
    if ours[0].run.has_episodes != theirs[0].run.has_episodes:
        raise UsageError(f"{ours[0].run.id} and {theirs[0].run.id} cannot be compared: one of them has no episodes")
    pairs = [(a, b) for a in ours for b in theirs if a.label == b.label]
    if len(pairs) < 2 and not (pairs and len(ours) == len(theirs) == 1):
        pairs = [(ours[0], side) for side in theirs if side != ours[0]]
    runs = {side.run.id: side.run for side in (ours[0], theirs[0]) if side.run.has_episodes}
    data = {name: load_study(store_of(run)) for name, run in runs.items()}
    return [(replace(a, data=data.get(a.run.id)), replace(b, data=data.get(b.run.id))) for a, b in pairs]


def compare(first: Side, second: Side) -> Comparison:
    """The differences between two sides. Raises UsageError: a setting without episodes."""
    if first.data is None or second.data is None:
        rows = _training_results(first.run, second.run)
    else:
        rows = _episode_results(first.data, first.label, second.data, second.label)
    return Comparison(first.name, second.name, differences(first, second), rows)


def differences(first: Side, second: Side) -> list[Difference]:
    """Settings, weights, machine and versions in which two sides differ."""
    ours, theirs = _settings_of(first), _settings_of(second)
    keys = dict.fromkeys([*ours, *theirs])
    return [Difference(k, ours.get(k), theirs.get(k)) for k in keys if ours.get(k) != theirs.get(k)]


def _settings_of(side: Side) -> Row:
    if side.data is None:
        description = description_of(side.run)
        settings: Row = dict(description.get("settings", {}))
        settings.update((key, description[key]) for key in ("git_commit", "versions", "demos") if key in description)
        return flatten(settings)
    setting, episodes = side.data.settings[side.label], _episodes(side.data, side.label)
    settings = flatten(without(setting.settings, NOT_DETERMINING - {"policy", "method"}))
    weights = {name: value[:12] for name, value in setting.identity.items() if name != OBSERVATION}
    circumstances = {
        key: ";".join(sorted({str(value) for value in episodes[key].dropna()}))
        for key in _STATUS_KEYS
        if key in episodes and len(episodes)
    }
    return {**settings, **weights, **_tasks_and_seeds(side.data, side.label), **circumstances}


def _tasks_and_seeds(data: StudyData, label: str) -> Row:
    wanted = [one for one in data.study.wanted if one.setting.label == label]
    tasks = ";".join(sorted({one.task for one in wanted}))
    return {"tasks": tasks, "seeds": seeds_text(one.seed for one in wanted)}


def _episode_results(first: StudyData, ours: str, second: StudyData, theirs: str) -> list[Row]:
    baseline, episodes = _episodes(first, ours), _episodes(second, theirs)
    if baseline.empty or episodes.empty:
        raise UsageError("one of the two settings has no episode yet: run it first")
    a, b = measure(baseline, baseline, MICRO), measure(episodes, baseline, MICRO, apart=True)
    rows = [
        _row("success", a["success"], b["success"], b, "difference", "difference"),
        _row("speed per episode", 1.0, b["episode_speedup"], b, "episode_speedup", "ratio of times per episode"),
        _row("speedup", 1.0, b["speedup"], b, "speedup", "ratio of times per step"),
    ]
    rows += _speedups(first, ours, second, theirs)
    rows += [
        {"measure": name, "first": a[name], "second": b[name], "change": b[name] - a[name]}
        for name in _MEASURES
        if is_number(a[name]) and is_number(b[name]) and (a[name] or b[name])
    ]
    rows.append({"measure": "pairs", "first": len(baseline), "second": len(episodes), "change": b["pairs"]})
    return rows


def _episodes(data: StudyData, label: str) -> pd.DataFrame:
    return data.episodes[data.episodes["label"] == label]


def _speedups(first: StudyData, ours: str, second: StudyData, theirs: str) -> Iterator[Row]:
    """The speedups of both settings against the baselines of their runs, and how far they differ: of two runs of one
    study, how far these agree."""
    a, b = (
        measure(_episodes(data, label), _episodes(data, data.references[label]), MICRO)
        for data, label in ((first, ours), (second, theirs))
    )
    names = list(dict.fromkeys((first.references[ours], second.references[theirs])))
    for column, unit in SPEEDS.items():
        if names not in ([ours], [theirs]) and is_number(a[column]) and is_number(b[column]):
            yield {"measure": f"{unit} against {' and '.join(names)}", "first": a[column], "second": b[column],
                   "change": b[column] / a[column], "what": "ratio of the speedups"}  # fmt: skip


def _row(name: str, first: float, second: float, measured: Row, column: str, what: str) -> Row:
    low, high = measured[f"{column}_low"], measured[f"{column}_high"]
    return {"measure": name, "first": first, "second": second, "change": measured[column], "low": low, "high": high,
            "what": what}  # fmt: skip


def _training_results(first: RunEntry, second: RunEntry) -> list[Row]:
    names = [name for name in first.figures if name in second.figures]
    return [
        {"measure": name, "first": first.figures[name], "second": second.figures[name],
         "change": second.figures[name] - first.figures[name]}
        for name in names
    ]  # fmt: skip


def same_tokens(first: RunEntry, second: RunEntry) -> tuple[int, int]:
    """(episodes with equal tokens, episodes) of the settings, tasks and seeds that both runs have.

    Raises:
        UsageError: no episode.
    """
    ours, theirs = _tokens(first), _tokens(second)
    shared = ours.keys() & theirs.keys()
    return sum(ours[key] == theirs[key] for key in shared), len(shared)


def _tokens(run: RunEntry) -> dict[tuple[str, str, int, int], list[list[int]]]:
    store = store_of(run)
    frame = store.frame()
    tokens: dict[tuple[str, str, int, int], list[list[int]]] = {}
    if frame.empty:
        return tokens
    decodes = store.decodes(frame["episode"].tolist(), ["tokens"]).to_pandas()
    keys = list(zip(*(frame[name] for name in ("label", "task", "seed", "repeat")), strict=True))
    for position, group in decodes.groupby("episode"):
        tokens[keys[int(str(position))]] = [list(row) for row in group["tokens"]]
    return tokens
