"""Build a study's tables from its stored episodes: over all tasks and per task, as data frames and CSV files."""

from __future__ import annotations

import functools
import itertools
import json
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from operator import itemgetter
from typing import Any

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.engine.tally import Tally
from kerv_cli.episodes.identity import NOT_DETERMINING, OBSERVATION, Plain, flat, stress_of, without
from kerv_cli.lab.plan import Episode, Setting, Study, seeds_text
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.acceptance import tally_of
from kerv_cli.report.matched import with_matched_speed
from kerv_cli.report.measures import MACRO, MICRO, Row, columns_of, measure, paired, speedups
from kerv_cli.report.statistics import NO_ESTIMATE, Estimate, over_runs
from kerv_cli.targets.provenance import PACKAGES
from kerv_cli.worlds import specs

CSV_COLUMNS = (
    "study", "averaging", "label", "method", "stress", "stress_level", "task", "seeds", "episodes", "baseline",
    "successes", "success", "success_low", "success_high", "runs", "speedup", "speedup_low", "speedup_high",
    "episode_speedup", "episode_speedup_low", "episode_speedup_high", "solved_speedup", "solved_speedup_low",
    "solved_speedup_high", "time_per_step_ms", "time_per_episode_ms", "latency_p95_ms", "AL", "forwards_per_step",
    "skip_rate", "unverified_share", "compensation_rate", "retrieval_share", "pairs", "only_baseline", "only_method",
    "mcnemar_p", "difference", "difference_low", "difference_high", "non_inferior", "pairs_to_settle",
    "steps_to_success", "near_contact_failure", "matched_success_speed",
)  # fmt: skip
"""Columns of a study's CSV files. The remaining values are in tables/<study>.json (`further_of`)."""

_RUNTIME = ("device", "dtype", "threads")
_PROVENANCE = (
    "executor", "workers", "device_name", "host", *(f"{name}_version" for name in PACKAGES), "python_version",
    "git_commit", "engine", "code", "run", "load",
)  # fmt: skip


_ONE_STATE = ("code", "git_commit", "device_name")
"""Columns in which runs must agree, to be averaged."""


@dataclass(frozen=True)
class StudyData:
    """A study (settings that are compared) with its stored episodes. Each table is computed once.

    Attributes:
        study: The settings, and the episodes that the study asks for.
        episodes: One row per stored episode (label, task, seed and repeat). Columns: those of `StudyStore.frame`, and
            difficulty, device, number format and threads.
        runs: One table like `episodes` for each of at least three runs (commands) with the same code on the same
            machine. Each run measured all episodes of the study, or all settings and tasks on seeds of its own. Empty
            if there are no such runs.
        same_pairs: Whether each run measured all episodes of the study.
        store: The study in the database, to read its decodes. None: the decodes are unknown.
    """

    study: Study
    episodes: pd.DataFrame
    runs: tuple[pd.DataFrame, ...] = ()
    same_pairs: bool = False
    store: StudyStore | None = None

    @functools.cached_property
    def settings(self) -> dict[str, Setting]:
        """The settings by label."""
        return {setting.label: setting for setting in self.study.settings}

    @functools.cached_property
    def labels(self) -> list[str]:
        """Labels of the settings that have episodes, in the study's order."""
        present = set(self.episodes["label"])
        return [label for label in self.study.labels if label in present]

    @property
    def absent(self) -> list[Episode]:
        """Episodes that the study asks for and that have not been stored yet."""
        names = ("label", "task", "seed", "repeat")
        present = set(zip(*(self.episodes[name] for name in names), strict=True))
        return [one for one in self.study.episodes if (one.setting.label, *one.key[1:]) not in present]

    @functools.cached_property
    def references(self) -> dict[str, str]:
        """For each setting's label, the label of the setting that it is compared with.

        That is the baseline's method under the same stress and clock, if the study has such a setting. Otherwise it is
        the study's baseline.
        """
        same: dict[str, str] = {}
        if baseline := self.settings.get(self.study.baseline):
            group = [one for one in self.study.settings if _methods_of(one) == _methods_of(baseline)]
            same = {_conditions_of(one): one.label for one in [*group, baseline]}
        return {label: same.get(_conditions_of(one), self.study.baseline) for label, one in self.settings.items()}

    def compared_with(self, label: str) -> StudyData:
        """Return the study with the setting `label` as its baseline, and with the name NAME_against_LABEL.

        Raises:
            UsageError: The study has no such setting.
        """
        if label not in self.settings:
            raise UsageError(f"baseline={label}: '{self.study.name}' has the settings {', '.join(self.labels)}")
        name = f"{self.study.name}_against_{re.sub(r'[^A-Za-z0-9.]+', '_', label)}"
        return replace(self, study=replace(self.study, name=name, baseline=label))

    @functools.cached_property
    def unstressed(self) -> dict[str, str]:
        """For each setting's label, the label of the same setting without stress.

        If the study does not run the setting without stress, the value is the label of the first setting that differs
        only in stress and `rollout.*`.
        """
        first: dict[str, str] = {}
        for setting in sorted(self.study.settings, key=lambda one: bool(stress_of(one.settings)["level"])):
            first.setdefault(_methods_of(setting), setting.label)
        return {
            label: first[_methods_of(one)] if stress_of(one.settings)["level"] else label
            for label, one in self.settings.items()
        }

    @functools.cached_property
    def pairs(self) -> pd.DataFrame:
        """Episodes of each setting, paired with those of the setting that it is compared with (`measures.paired`)."""
        return paired(self.episodes, self.references)

    @functools.cached_property
    def run_pairs(self) -> list[pd.DataFrame]:
        """One table like `pairs` for each run in `runs`, with the episodes that this run measured."""
        return [paired(run, self.references) for run in self.runs]

    @functools.cached_property
    def tallies(self) -> dict[str, Tally]:
        """How many draft tokens were accepted, by place, for each setting that verified drafts. Reads all decodes."""
        if self.store is None:
            return {}
        episodes = self.episodes.groupby("label")["episode"]
        found = {label: tally_of(self.store, episodes.get_group(label).tolist()) for label in self.labels}
        return {label: tally for label, tally in found.items() if tally is not None}

    @functools.cached_property
    def table(self) -> pd.DataFrame:
        """Two rows per setting: one pools all tasks (micro), one averages over difficulty groups (macro)."""
        return pd.DataFrame(row for averaging in (MICRO, MACRO) for row in with_matched_speed(_rows(self, averaging)))

    @functools.cached_property
    def per_task(self) -> pd.DataFrame:
        """One row per task and setting. Tasks are sorted by name, settings are in the study's order."""
        by_task = itertools.groupby(_rows(self, "one task", by_task=True), key=itemgetter("task"))
        return pd.DataFrame(row for _, rows in by_task for row in with_matched_speed(list(rows)))


def _conditions_of(setting: Setting) -> str:
    """Return a setting's stress and its settings `rollout.*` as JSON, to find settings under the same conditions."""
    return json.dumps([stress_of(setting.settings), setting.settings["rollout"]], sort_keys=True)


def _methods_of(setting: Setting) -> str:
    """Return everything that determines a setting's results, except stress and the settings `rollout.*`, as JSON."""
    world = without(setting.settings["world"], {"stress"})
    others = without(setting.settings, (NOT_DETERMINING - {"policy"}) | {"world", "rollout"})
    return json.dumps([world, others, dict(setting.identity)], sort_keys=True)


def load_study(store: StudyStore, wanted: Sequence[Episode] | None = None) -> StudyData:
    """Read a study and its stored episodes.

    Args:
        store: The study's files.
        wanted: Episodes to read. Settings without any of them are left out. None: read everything.

    Raises:
        UsageError: There is no such study, or none of its episodes is stored.
    """
    study = store.load()
    if wanted is not None:
        labels = {one.setting.label for one in wanted}
        settings = tuple(setting for setting in study.settings if setting.label in labels)
        study = replace(study, settings=settings, episodes=tuple(wanted))
    frame = store.frame(wanted)
    if frame.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {store.how_to_run()}")
    whole = store.whole_runs() if wanted is None else []
    same_pairs = len(whole) > 2
    frames = [store.frame(run=run) for run in whole] if same_pairs else _with_new_seeds(frame)
    names = [name for name in _ONE_STATE if name in frame]  # imported episodes may lack some
    alike = [one for one in frames if all(set(one[name]) == set(frame[name]) for name in names)]
    runs = [_labelled(study, one) for one in alike] if len(alike) > 2 else []
    return StudyData(study, _labelled(study, frame), tuple(runs), same_pairs, store)


def _with_new_seeds(episodes: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the episodes of each run, oldest first, if each run measured every setting in every task on its own seeds.

    Otherwise return an empty list.
    """
    runs = [one for _, one in sorted(episodes.groupby("run"), key=lambda item: item[1]["started"].min())]
    keys = [set(zip(one["label"], one["task"], strict=True)) for one in runs]
    complete = all(len(one) == episodes["label"].nunique() * episodes["task"].nunique() for one in keys)
    worlds = [episode for one in runs for episode in set(zip(one["task"], one["seed"], strict=True))]
    return runs if complete and len(worlds) == len(set(worlds)) else []


def _labelled(study: Study, episodes: pd.DataFrame) -> pd.DataFrame:
    """Add the columns difficulty, device, dtype and threads to the episodes."""
    groups = {task: difficulty_of(task) for task in set(episodes["task"])}
    runtime = {setting.label: setting.settings["runtime"] for setting in study.settings}
    columns = {name: episodes["label"].map({k: v[name] for k, v in runtime.items()}) for name in _RUNTIME}
    # strings as Python objects: these frames are cut into hundreds of small ones, and arrow's arrays are slow at that
    texts = {
        name: episodes[name].astype(object) for name in ("label", "task", "block", "started", "device_name", "run")
    }
    states = episodes["initial_state"].map(tuple)  # tuples can be compared
    episodes = episodes.assign(difficulty=episodes["task"].map(groups), initial_state=states, **columns, **texts)
    return episodes.astype(dict.fromkeys(("difficulty", "device", "dtype"), object))


def difficulty_of(task: str) -> str:
    """Return the task's difficulty group, or `other` if no environment has the task."""
    return next((spec.tasks[task].difficulty for spec in specs().values() if task in spec.tasks), "other")


def _rows(data: StudyData, averaging: str, by_task: bool = False) -> list[Row]:
    """Return a table row per setting, or per task and setting: its name, measures, settings and provenance.

    If the episodes have different values in a provenance column, the values are joined by semicolons.

    Args:
        data: The study.
        averaging: MICRO (pool all episodes), MACRO (average over difficulty groups), or any other name for the episodes
            of one task.
        by_task: Whether to return rows per task.
    """
    by = ["task", "label"] if by_task else ["label"]
    measured = measure(data.episodes, data.pairs, by, averaging)
    runs = [speedups(pairs, by, averaging) for pairs in data.run_pairs]
    episodes, indices = data.episodes, data.episodes.groupby(by).indices
    known = [name for name in ("task", "difficulty", "seed", "repeat", *_PROVENANCE) if name in episodes]
    columns = {name: episodes[name].astype(object).where(episodes[name].notna(), None).to_numpy() for name in known}
    groups: Iterable[tuple[Hashable, str]] = ((label, label) for label in data.labels)
    if by_task:
        groups = (((task, label), label) for task in sorted(set(episodes["task"])) for label in data.labels)
    rows = []
    for group, label in groups:
        if group not in indices:
            continue
        values = {name: pd.unique(column[indices[group]]) for name, column in columns.items()}
        setting = data.settings[label]
        stress, hashes = stress_of(setting.settings), without(setting.identity, {OBSERVATION})
        varied = [f"{key.split('.')[-1]} {value}" for key, value in setting.varies.items() if key != data.study.axis]
        rows.append(
            {
                "study": data.study.name,
                "averaging": averaging,
                "label": label,
                # settings that differ only along the study's axis are one series
                "series": ", ".join([setting.name.rstrip(", "), *varied]),
                "unstressed": data.unstressed[label],
                "method": setting.settings["method"],
                "task": _joined(sorted(values["task"])),
                "tasks": len(values["task"]),
                "difficulty": _joined(sorted(values["difficulty"])),
                "seeds": seeds_text(values["seed"]),
                "repeats": len(values["repeat"]),
                "episodes": len(indices[group]),
                "baseline": data.references[label],
                **measured[group],
                "runs": max(1, len(runs)),
                **_over_runs(runs, group, data.same_pairs),
                "overrides": setting.overrides,
                **flatten(without(setting.settings, NOT_DETERMINING - {"policy"})),
                "observation": setting.identity.get(OBSERVATION, ""),
                **{f"{name}_sha256": value for name, value in sorted(hashes.items())},
                "stress": stress["kind"],
                "stress_level": stress["level"],
                **{name: _joined(one for one in values.get(name, ()) if one is not None) for name in _PROVENANCE},
            }
        )
    return rows


def _over_runs(runs: Sequence[Mapping[str, Mapping[Hashable, Estimate]]], group: Hashable, same_pairs: bool) -> Row:
    """Return the speeds of a group over all runs, if there are several (docs/methods.md §7).

    Args:
        runs: What `measures.speedups` returned for each run.
        group: Key of the group in those results.
        same_pairs: Whether all runs measured the same pairs.
    """
    row: Row = {}
    for name in runs[0] if runs else ():
        row |= columns_of(name, over_runs([run[name].get(group, NO_ESTIMATE) for run in runs], same_pairs))
    return row


def flatten(settings: Plain) -> Row:
    """Return nested settings as one dictionary with dotted keys, such as `threshold.r`.

    The values of a list become one text, separated by semicolons.
    """
    return {k: _joined(v) if isinstance(v, list | tuple) else v for k, v in flat(settings).items()}


def differences(first: Row, second: Row) -> list[tuple[str, Any, Any]]:
    """Return every key whose values differ, with both values. A value is None if that side does not have the key."""
    pairs = ((key, first.get(key), second.get(key)) for key in first | second)
    return [pair for pair in pairs if pair[1] != pair[2]]


def _joined(values: Iterable[object]) -> str:
    return ";".join(dict.fromkeys(str(value) for value in values))


def values_of(table: pd.DataFrame, column: str) -> set[str]:
    """Return all different values in a column. A cell may hold several values, joined by semicolons."""
    return {value for text in table[column].astype(str) for value in text.split(";")}


def further_of(data: StudyData) -> dict[str, Any]:
    """Return everything that a study's CSV files leave out, as JSON values.

    Returns:
        A dictionary with the keys `study` (its name), `axis` (key of the plots' x axis) and `labels`. The last maps
        each setting's label to a dictionary:

        - `name`, `overrides` and `settings` of the setting
        - `varies`: values of the keys that differ within its grid
        - `identity`: hashes of weights and data
        - `provenance`: executor, machine, versions and the like
        - `measures`: for each averaging and each task, the measures that have no column in the CSV files
        - `acceptance`: how many draft tokens were accepted, by place, over all tasks; only if drafts were verified
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
    for label, tally in data.tallies.items():
        labels[label]["acceptance"] = tally.as_dict()
    return {"study": data.study.name, "axis": data.study.axis, "labels": labels}


def _json(value: Any) -> Any:
    """Return the value, or None if it is NaN or infinite, which JSON cannot hold."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def csv_text(table: pd.DataFrame) -> str:
    """Return the table as CSV text with six significant digits. Missing values are empty cells."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


def is_number(value: Any) -> bool:
    """Return whether a value is a real number other than NaN. Text, bool and None are not."""
    return isinstance(value, Real) and not isinstance(value, bool) and not math.isnan(value)


def is_baseline(row: Row) -> bool:
    """Return whether the row belongs to the baseline itself, which is not compared with anything."""
    return bool(row["label"] == row["baseline"])


def rows_of(table: pd.DataFrame, averaging: str | None = None) -> list[Row]:
    """Return the rows of a table as dictionaries of column to value.

    Args:
        table: The table.
        averaging: Keep only rows that pool all episodes (MICRO) or that average over difficulty groups (MACRO). None:
            keep all rows.
    """
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
    """Return the rows of settings whose world goes on during a decode (`rollout.clock=real`).

    The baseline must have such a world, too. The added column `ar_latency_ms` is the mean latency of its decodes.
    """
    rows = table[table["averaging"] == MICRO]
    latencies = dict(zip(rows["label"], rows["felt_latency_ms"], strict=True))
    rows = rows.assign(ar=rows["baseline"], ar_latency_ms=rows["baseline"].map(latencies))
    return rows.loc[rows["felt_latency_ms"].map(is_number) & rows["ar_latency_ms"].map(is_number), list(_COLUMNS)]
