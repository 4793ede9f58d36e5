"""Tables of a study from its stored episodes: per task and aggregated, as data frames and CSV files."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_text
from kerv_cli.base.provenance import PACKAGES
from kerv_cli.episodes.identity import (
    NOT_DETERMINING,
    NOT_DETERMINING_RUNTIME,
    OBSERVATION,
    Plain,
    flat,
    stress_of,
    without,
    work_of,
)
from kerv_cli.lab.plan import Setting, Study, Wanted, seeds_text
from kerv_cli.lab.store import StudyStore
from kerv_cli.methods.settings import MODEL
from kerv_cli.report.measures import MACRO, MICRO, Row, measure
from kerv_cli.worlds import specs

_RUNTIME = ("device", "dtype", "threads")
_MACHINE = ("executor", "workers", "device_name", "host")
_CODE = ("git_commit", "engine", "code", "run")
CSV_COLUMNS = (
    "study", "averaging", "label", "method", "stress", "stress_level", "task", "seeds", "episodes", "baseline",
    "successes", "success", "success_low", "success_high", "speedup", "speedup_low", "speedup_high",
    "episode_speedup", "episode_speedup_low", "episode_speedup_high", "time_per_step_ms",
    "time_per_episode_ms", "latency_p50_ms", "latency_p95_ms", "latency_worst_ms", "AL", "forwards_per_step",
    "skip_rate", "unverified_share", "compensation_rate", "retrieval_share", "deviation", "pairs", "only_baseline",
    "only_method", "mcnemar_p", "difference", "difference_low", "difference_high", "non_inferior", "pairs_to_settle",
    "steps", "decodes", "steps_to_success",
)  # fmt: skip
"""Columns of a study's CSV files. The other measures and the settings are in `further_of`, tables/<study>.json."""
_STATUS_COLUMNS = (*_MACHINE, *(f"{name}_version" for name in PACKAGES), "python_version", *_CODE)


@dataclass(frozen=True)
class StudyData:
    """A study and those of its episodes that are there; its tables are computed once.

    Attributes:
        study: Its settings and what it wants.
        episodes: A row per label, task, seed and repeat; columns of `StudyStore.frame` and those of `_labelled`.
    """

    study: Study
    episodes: pd.DataFrame

    @functools.cached_property
    def settings(self) -> dict[str, Setting]:
        """Label -> its setting."""
        return {setting.label: setting for setting in self.study.settings}

    @functools.cached_property
    def labels(self) -> list[str]:
        """Labels that have episodes, in the study's order."""
        there = set(self.episodes["label"])
        return [label for label in self.study.labels if label in there]

    @property
    def absent(self) -> list[Wanted]:
        """Episodes that are wanted and not there."""
        names = ("label", "task", "seed", "repeat")
        there = set(zip(*(self.episodes[name] for name in names), strict=True))
        return [one for one in self.study.wanted if (one.setting.label, *one.key[1:]) not in there]

    @functools.cached_property
    def references(self) -> dict[str, str]:
        """Label -> the label that it is compared with.

        It is the baseline's setting under its own stress if the study has it, else the baseline.
        """
        baseline = self.settings.get(self.study.baseline)
        if baseline is None:
            return dict.fromkeys(self.settings, self.study.baseline)
        plain = _unstressed(baseline)
        same = {_stress(one): label for label, one in self.settings.items() if _unstressed(one) == plain}
        same[_stress(baseline)] = self.study.baseline
        return {label: same.get(_stress(one), self.study.baseline) for label, one in self.settings.items()}

    @functools.cached_property
    def unstressed(self) -> dict[str, str]:
        """Label -> what the setting is called in a study of stress, whatever its stress.

        It is the label of the same setting without stress. Without one it is the method, or if several such settings
        share a method the first label.
        """
        groups: dict[str, list[Setting]] = {}
        for setting in self.study.settings:
            groups.setdefault(_unstressed(setting), []).append(setting)
        methods = Counter(str(group[0].settings["method"]) for group in groups.values())
        names: dict[str, str] = {}
        for group in groups.values():
            plain, method = [one for one in group if not _stress(one)[1]], str(group[0].settings["method"])
            name = plain[0].label if plain else method if methods[method] == 1 else group[0].label
            names |= {one.label: one.label if one in plain else name for one in group}
        return names

    @functools.cached_property
    def table(self) -> pd.DataFrame:
        """Two rows per label: micro over tasks and macro over difficulty groups."""
        return _frame([row for averaging in (MICRO, MACRO) for row in _rows(self, self.episodes, averaging)])

    @functools.cached_property
    def per_task(self) -> pd.DataFrame:
        """One row per task and label: tasks by name, labels in the study's order."""
        by_task = [episodes for _, episodes in self.episodes.groupby("task", sort=True)]
        return _frame([row for episodes in by_task for row in _rows(self, episodes, "one task")])


def _stress(setting: Setting) -> tuple[str, int]:
    stress = stress_of(setting.settings)
    return stress["kind"], stress["level"]


def _unstressed(setting: Setting) -> str:
    """Return the hash of what determines a setting, apart from its stress."""
    plain = {**setting.settings, "world": without(setting.settings["world"], {"stress"})}
    return work_of(plain, setting.identity)


def load_study(store: StudyStore, wanted: Sequence[Wanted] | None = None) -> StudyData:
    """Return a study and its episodes; with `wanted`, a study of only those.

    Raises:
        UsageError: No such study, or none of its episodes is there.
    """
    study = store.load()
    if wanted is not None:
        labels = {one.setting.label for one in wanted}
        settings = tuple(setting for setting in study.settings if setting.label in labels)
        study = replace(study, settings=settings, wanted=tuple(wanted))
    frame = store.frame(wanted)
    if frame.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {store.how_to_run()}")
    return StudyData(study, _labelled(study, frame))


def _labelled(study: Study, episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the episodes with the columns of their settings that the tables need."""
    groups = {task: difficulty_of(task) for task in set(episodes["task"])}
    runtime = {setting.label: setting.settings["runtime"] for setting in study.settings}
    columns = {name: episodes["label"].map({k: v[name] for k, v in runtime.items()}) for name in _RUNTIME}
    # strings as Python objects: these frames are cut into hundreds of small ones, which arrow's arrays are slow at
    texts = {
        name: episodes[name].astype(object) for name in ("label", "task", "block", "started", "device_name", "run")
    }
    states = episodes["initial_state"].map(tuple)  # comparable
    episodes = episodes.assign(difficulty=episodes["task"].map(groups), initial_state=states, **columns, **texts)
    return episodes.astype(dict.fromkeys(("difficulty", "device", "dtype"), object))


def difficulty_of(task: str) -> str:
    """The task's difficulty group; `other` for a task that no environment has."""
    return next((spec.tasks[task].difficulty for spec in specs().values() if task in spec.tasks), "other")


Sections = list[Row]
"""One row of a table as sections of columns. A column that only some settings have stays within its section."""


def _frame(rows: Sequence[Sections]) -> pd.DataFrame:
    """Rows as a table; within each section, columns that only later rows have are appended."""
    columns = [name for parts in zip(*rows, strict=True) for part in parts for name in part]
    merged = [{name: value for part in row for name, value in part.items()} for row in rows]
    return pd.DataFrame(merged, columns=list(dict.fromkeys(columns)))


def _rows(data: StudyData, episodes: pd.DataFrame, averaging: str) -> Iterator[Sections]:
    """One row per label that has episodes here."""
    for label in data.study.labels:
        group = episodes[episodes["label"] == label]
        if len(group):
            baseline = episodes[episodes["label"] == data.references[label]]
            yield _row(data, label, group, baseline, averaging)


def _row(data: StudyData, label: str, episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str) -> Sections:
    tasks = sorted(set(episodes["task"]))
    setting = data.settings[label]
    head = {
        "study": data.study.name,
        "averaging": averaging,
        "label": label,
        "name": setting.name,
        "unstressed": data.unstressed[label],
        "method": setting.settings["method"],
        "task": ";".join(tasks),
        "tasks": len(tasks),
        "difficulty": _joined(sorted(set(episodes["difficulty"]))),
        "seeds": seeds_text(episodes["seed"]),
        "repeats": int(episodes["repeat"].nunique()),
        "episodes": len(episodes),
        "baseline": data.references[label],
    }
    measures = measure(episodes, baseline, averaging)
    return [head, measures, *_origin(setting, episodes)]


def _origin(setting: Setting, episodes: pd.DataFrame) -> Sections:
    """Return settings, weights and provenance of a row; values that differ are joined by semicolons."""
    settings, policy = setting.settings, setting.settings["policy"]
    world, runtime, stress = settings["world"], settings["runtime"], stress_of(settings)
    parts = without(settings, {*NOT_DETERMINING, "world", "runtime"})
    weights = {
        "policy.kind": policy.get("kind", MODEL),
        "target": policy["target"],
        "artifacts": _joined(f"{kind}={name}" for kind, name in policy.get("artifacts", {}).items() if name),
        OBSERVATION: setting.identity.get(OBSERVATION, ""),
        **{f"{name}_sha256": value for name, value in sorted(setting.identity.items()) if name != OBSERVATION},
    }
    surroundings = {
        "horizon": world["horizon"],
        "camera": world["camera"]["name"],
        **flatten({"camera": without(world["camera"], {"name"})}),
        "stress": stress["kind"],
        "stress_level": stress["level"],
        **without(runtime, NOT_DETERMINING_RUNTIME),
        **{key: _joined(episodes[key].dropna()) if key in episodes else "" for key in _STATUS_COLUMNS},
    }
    return [{"overrides": setting.overrides}, flatten(parts), weights, surroundings]


def is_autoregressive(settings: Plain) -> bool:
    """Whether a setting is a model that decodes token by token: nothing drafts, nothing is skipped."""
    drafts = any(settings[part]["kind"] != "none" for part in ("prefill_draft", "proposer", "skip"))
    return not drafts and settings["policy"]["kind"] == MODEL


def flatten(settings: Plain) -> Row:
    """Nested settings as dotted keys: {"threshold": {"r": 5}} -> {"threshold.r": 5}; lists joined by semicolons."""
    return {k: _joined(v) if isinstance(v, list | tuple) else v for k, v in flat(settings).items()}


def _joined(values: Iterable[object]) -> str:
    return ";".join(dict.fromkeys(str(value) for value in values))


def values_of(table: pd.DataFrame, column: str) -> set[str]:
    """The values of a column whose rows join several by semicolons."""
    return {value for text in table[column].astype(str) for value in text.split(";")}


def further_of(data: StudyData) -> dict[str, Any]:
    """Return what a study's CSV files leave out, as JSON values, by label.

    A label has `name` and `varies` (of a grid), `overrides`, `settings`, `identity` (hashes of weights and data),
    `provenance` of its episodes, and `measures`: averaging, or task, -> the measures that are no column.
    """
    columns = list(data.table.columns)
    left_out = {*CSV_COLUMNS, "name", "unstressed"}
    measures = [name for name in columns[: columns.index("overrides")] if name not in left_out]
    labels: dict[str, Any] = {}
    for rows, key in ((rows_of(data.table), "averaging"), (rows_of(data.per_task), "task")):
        for row in rows:
            setting = data.settings[row["label"]]
            about = {
                "name": setting.name,
                "varies": dict(setting.varies),
                "overrides": setting.overrides,
                "settings": without(setting.settings, {"results", "task"}),
                "identity": dict(setting.identity),
                "provenance": {name: _json(row[name]) for name in (*_RUNTIME, *_STATUS_COLUMNS)},
                "measures": {},
            }
            values = {name: _json(row[name]) for name in measures}
            labels.setdefault(row["label"], about)["measures"][row[key]] = values
    return {"study": data.study.name, "axis": data.study.axis, "labels": labels}


def _json(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def csv_text(table: pd.DataFrame) -> str:
    """CSV with six significant digits; empty where a value does not exist."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


def write_csv(table: pd.DataFrame, path: Path) -> Path:
    """Writes `csv_text` atomically.

    Raises:
        StorageError: the disk refused.
    """
    write_text(path, csv_text(table))
    return path


def is_number(value: Any) -> bool:
    """Whether a value exists: neither None nor NaN."""
    return value is not None and not math.isnan(value)


def is_baseline(row: Row) -> bool:
    """Whether the row of a table is that of the setting which it is compared with."""
    return bool(row["label"] == row["baseline"])


def rows_of(table: pd.DataFrame, averaging: str | None = None) -> list[Row]:
    """The table's rows, or those of one averaging, as dicts by column."""
    rows = table if averaging is None else table[table["averaging"] == averaging]
    return [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
