"""Tables of a study from its stored episodes: aggregated and per task, as data frames and CSV files."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.episodes.identity import NOT_DETERMINING, OBSERVATION, Plain, flat, stress_of, without
from kerv_cli.lab.plan import Episode, Setting, Study, seeds_text
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.measures import MACRO, MICRO, Row, measure
from kerv_cli.targets.provenance import PACKAGES
from kerv_cli.worlds import specs

CSV_COLUMNS = (
    "study", "averaging", "label", "method", "stress", "stress_level", "task", "seeds", "episodes", "baseline",
    "successes", "success", "success_low", "success_high", "speedup", "speedup_low", "speedup_high",
    "episode_speedup", "episode_speedup_low", "episode_speedup_high", "time_per_step_ms",
    "time_per_episode_ms", "latency_p50_ms", "latency_p95_ms", "latency_worst_ms", "AL", "forwards_per_step",
    "skip_rate", "unverified_share", "compensation_rate", "retrieval_share", "deviation", "pairs", "only_baseline",
    "only_method", "mcnemar_p", "difference", "difference_low", "difference_high", "non_inferior", "pairs_to_settle",
    "steps", "decodes", "steps_to_success",
)  # fmt: skip
"""Columns of a study's CSV files. `further_of` holds the rest, in tables/<study>.json."""

_RUNTIME = ("device", "dtype", "threads")
_PROVENANCE = (
    "executor", "workers", "device_name", "host", *(f"{name}_version" for name in PACKAGES), "python_version",
    "git_commit", "engine", "code", "run",
)  # fmt: skip


@dataclass(frozen=True)
class StudyData:
    """A study and its episodes that are there. Its tables are computed once.

    Attributes:
        study: Its settings and the episodes that it wants.
        episodes: A row per label, task, seed and repeat; columns of `StudyStore.frame` and of `_labelled`.
    """

    study: Study
    episodes: pd.DataFrame

    @functools.cached_property
    def settings(self) -> dict[str, Setting]:
        """Settings by label."""
        return {setting.label: setting for setting in self.study.settings}

    @functools.cached_property
    def labels(self) -> list[str]:
        """Labels that have episodes, in the study's order."""
        present = set(self.episodes["label"])
        return [label for label in self.study.labels if label in present]

    @property
    def absent(self) -> list[Episode]:
        """Episode episodes that are missing."""
        names = ("label", "task", "seed", "repeat")
        present = set(zip(*(self.episodes[name] for name in names), strict=True))
        return [one for one in self.study.episodes if (one.setting.label, *one.key[1:]) not in present]

    @functools.cached_property
    def references(self) -> dict[str, str]:
        """Label -> the label that it is compared with.

        It is the baseline under the setting's own stress and clock if the study has it, else the baseline.
        """
        same: dict[str, str] = {}
        if baseline := self.settings.get(self.study.baseline):
            group = [one for one in self.study.settings if _methods_of(one) == _methods_of(baseline)]
            same = {_conditions_of(one): one.label for one in [*group, baseline]}
        return {label: same.get(_conditions_of(one), self.study.baseline) for label, one in self.settings.items()}

    @functools.cached_property
    def unstressed(self) -> dict[str, str]:
        """Label -> the label of the same setting without stress; without one, the first of its stressed settings."""
        first: dict[str, str] = {}
        for setting in sorted(self.study.settings, key=lambda one: bool(stress_of(one.settings)["level"])):
            first.setdefault(_methods_of(setting), setting.label)
        return {
            label: first[_methods_of(one)] if stress_of(one.settings)["level"] else label
            for label, one in self.settings.items()
        }

    @functools.cached_property
    def table(self) -> pd.DataFrame:
        """Two rows per label: micro over tasks and macro over difficulty groups."""
        return pd.DataFrame(row for averaging in (MICRO, MACRO) for row in _rows(self, self.episodes, averaging))

    @functools.cached_property
    def per_task(self) -> pd.DataFrame:
        """One row per task and label: tasks by name, labels in the study's order."""
        by_task = self.episodes.groupby("task", sort=True)
        return pd.DataFrame(row for _, episodes in by_task for row in _rows(self, episodes, "one task"))


def _conditions_of(setting: Setting) -> str:
    """Return stress and clock, under which methods are compared, as text."""
    return json.dumps([stress_of(setting.settings), setting.settings["rollout"]], sort_keys=True)


def _methods_of(setting: Setting) -> str:
    """Return everything else that determines a setting, as text."""
    world = without(setting.settings["world"], {"stress"})
    others = without(setting.settings, (NOT_DETERMINING - {"policy"}) | {"world", "rollout"})
    return json.dumps([world, others, dict(setting.identity)], sort_keys=True)


def load_study(store: StudyStore, wanted: Sequence[Episode] | None = None) -> StudyData:
    """Return a study and its episodes; with `wanted`, a study of only those.

    Raises:
        UsageError: No such study, or none of its episodes is there.
    """
    study = store.load()
    if wanted is not None:
        labels = {one.setting.label for one in wanted}
        settings = tuple(setting for setting in study.settings if setting.label in labels)
        study = replace(study, settings=settings, episodes=tuple(wanted))
    frame = store.frame(wanted)
    if frame.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {store.how_to_run()}")
    return StudyData(study, _labelled(study, frame))


def _labelled(study: Study, episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the episodes with difficulty, device, dtype and threads."""
    groups = {task: difficulty_of(task) for task in set(episodes["task"])}
    runtime = {setting.label: setting.settings["runtime"] for setting in study.settings}
    columns = {name: episodes["label"].map({k: v[name] for k, v in runtime.items()}) for name in _RUNTIME}
    # strings as Python objects: these frames are cut into hundreds of small ones, and arrow's arrays are slow at that
    texts = {
        name: episodes[name].astype(object) for name in ("label", "task", "block", "started", "device_name", "run")
    }
    states = episodes["initial_state"].map(tuple)  # comparable
    episodes = episodes.assign(difficulty=episodes["task"].map(groups), initial_state=states, **columns, **texts)
    return episodes.astype(dict.fromkeys(("difficulty", "device", "dtype"), object))


def difficulty_of(task: str) -> str:
    """Return the task's difficulty group; `other` if no environment has the task."""
    return next((spec.tasks[task].difficulty for spec in specs().values() if task in spec.tasks), "other")


def _rows(data: StudyData, episodes: pd.DataFrame, averaging: str) -> Iterator[Row]:
    """Yield one row per label that has episodes here."""
    by_label = {str(label): group for label, group in episodes.groupby("label", sort=False)}
    for label in data.study.labels:
        if label in by_label:
            baseline = by_label.get(data.references[label], episodes.iloc[:0])
            yield _row(data, label, by_label[label], baseline, averaging)


def _row(data: StudyData, label: str, episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str) -> Row:
    """Return identity, measures, settings and provenance; values that differ are joined by semicolons."""
    tasks, setting = sorted(set(episodes["task"])), data.settings[label]
    stress, hashes = stress_of(setting.settings), without(setting.identity, {OBSERVATION})
    varied = [f"{key.split('.')[-1]} {value}" for key, value in setting.varies.items() if key != data.study.axis]
    return {
        "study": data.study.name,
        "averaging": averaging,
        "label": label,
        "series": ", ".join([setting.name.rstrip(", "), *varied]),  # settings that differ only along the study's axis
        "unstressed": data.unstressed[label],
        "method": setting.settings["method"],
        "task": ";".join(tasks),
        "tasks": len(tasks),
        "difficulty": _joined(sorted(set(episodes["difficulty"]))),
        "seeds": seeds_text(episodes["seed"]),
        "repeats": int(episodes["repeat"].nunique()),
        "episodes": len(episodes),
        "baseline": data.references[label],
        **measure(episodes, baseline, averaging),
        "overrides": setting.overrides,
        **flatten(without(setting.settings, NOT_DETERMINING - {"policy"})),
        "observation": setting.identity.get(OBSERVATION, ""),
        **{f"{name}_sha256": value for name, value in sorted(hashes.items())},
        "stress": stress["kind"],
        "stress_level": stress["level"],
        **{key: _joined(episodes[key].dropna()) if key in episodes else "" for key in _PROVENANCE},
    }


def flatten(settings: Plain) -> Row:
    """Return nested settings with dotted keys, such as `threshold.r`; lists are joined by semicolons."""
    return {k: _joined(v) if isinstance(v, list | tuple) else v for k, v in flat(settings).items()}


def _joined(values: Iterable[object]) -> str:
    return ";".join(dict.fromkeys(str(value) for value in values))


def values_of(table: pd.DataFrame, column: str) -> set[str]:
    """Return the values of a column whose rows join several by semicolons."""
    return {value for text in table[column].astype(str) for value in text.split(";")}


def further_of(data: StudyData) -> dict[str, Any]:
    """Return what a study's CSV files leave out, as JSON values by label.

    A label has `name` and `varies` (of a grid), `overrides`, `settings`, `identity` (hashes of weights and data),
    `provenance`, and `measures`: averaging or task -> the measures that have no CSV column.
    """
    columns = list(data.table.columns)
    left_out = {*CSV_COLUMNS, "series", "unstressed"}
    measures = [name for name in columns[: columns.index("overrides")] if name not in left_out]
    labels: dict[str, Any] = {}
    for row in [*rows_of(data.table), *rows_of(data.per_task)]:
        setting = data.settings[row["label"]]
        about = {
            "name": setting.name,
            "varies": dict(setting.varies),
            "overrides": setting.overrides,
            "settings": without(setting.settings, {"results", "task"}),
            "identity": dict(setting.identity),
            "provenance": {name: setting.settings["runtime"][name] for name in _RUNTIME}
            | {name: row[name] for name in _PROVENANCE},
            "measures": {},
        }
        key = row["averaging"] if row["averaging"] in (MICRO, MACRO) else row["task"]
        values = {name: _json(row[name]) for name in measures}
        labels.setdefault(row["label"], about)["measures"][key] = values
    return {"study": data.study.name, "axis": data.study.axis, "labels": labels}


def _json(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def csv_text(table: pd.DataFrame) -> str:
    """Return CSV with six significant digits; a cell is empty if its value does not exist."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


def is_number(value: Any) -> bool:
    """Return whether a value is a number: neither text, bool, None nor NaN."""
    return isinstance(value, Real) and not isinstance(value, bool) and not math.isnan(value)


def is_baseline(row: Row) -> bool:
    """Return whether a row's setting is the one that it is compared with."""
    return bool(row["label"] == row["baseline"])


def rows_of(table: pd.DataFrame, averaging: str | None = None) -> list[Row]:
    """Return the table's rows, or the rows of one averaging, as dicts by column."""
    rows = table if averaging is None else table[table["averaging"] == averaging]
    return [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]


_COLUMNS = (
    "study", "label", "method", "ar", "rollout.clock", "rollout.latency", "rollout.latency_ms", "rollout.profile",
    "rollout.ar_ms", "rollout.delay_compensation", "rollout.batch", "ar_latency_ms", "episodes", "felt_latency_ms",
    "felt_latency_steps", "held_share", "forwards_per_step", "successes", "success", "success_low", "success_high",
    "pairs", "difference", "difference_low", "difference_high", "only_baseline", "only_method", "mcnemar_p",
    "prefill_draft.kind", "proposer.kind",
)  # fmt: skip


def latency_table(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a study's table whose world, and whose baseline's world, goes on during a decode.

    Its additional column `ar_latency_ms` is the mean latency of the baseline's decodes.
    """
    rows = table[table["averaging"] == MICRO]
    latencies = dict(zip(rows["label"], rows["felt_latency_ms"], strict=True))
    rows = rows.assign(ar=rows["baseline"], ar_latency_ms=rows["baseline"].map(latencies))
    return rows.loc[rows["felt_latency_ms"].map(is_number) & rows["ar_latency_ms"].map(is_number), list(_COLUMNS)]
