"""Build a study's tables from its stored episodes: over all tasks and per task, as data frames and CSV files."""

from __future__ import annotations

import functools
import itertools
import json
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from kerv_cli.base.errors import UsageError
from kerv_cli.episodes.identity import NOT_DETERMINING, OBSERVATION, Plain, Setting, flat, stress_of, without
from kerv_cli.lab.plan import Episode, seeds_text
from kerv_cli.lab.store import Study
from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import Speeds, compared, measure, paired, speedups
from kerv_cli.report.results import MACRO, MICRO, ONE_TASK, Result, Row, averaged, columns_of, frame_of, is_number
from kerv_cli.report.statistics import PairedCounts
from kerv_cli.report.tally import Tally
from kerv_cli.report.verdict import with_matched_speed
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


NO_STRESS = "none"
_AT_ONCE = 200  # episodes in memory at a time
_ONE_STATE = ("code", "git_commit", "device_name")
"""Columns in which runs must agree, to be averaged."""


@dataclass(frozen=True)
class StudyData:
    """A study (settings that are compared) with its stored episodes. Each table is computed once.

    Attributes:
        study: The settings, and the episodes that the study asks for.
        episodes: One row per stored episode (label, task, seed and repeat). Columns: those of `Study.frame`, and
            difficulty, device, number format and threads.
        runs: One table like `episodes` per run (command). All runs used the same code on the same machine. Each run
            measured all episodes of the study, or else all settings and tasks on its own seeds. Empty if there are
            fewer than three such runs.
        same_pairs: Whether each run measured all episodes of the study.
        against: Suffix of the tables' names, such as `_against_ar`, if the user chose another baseline than the
            study's own. Else empty.
    """

    study: Study
    episodes: pd.DataFrame
    runs: tuple[pd.DataFrame, ...] = ()
    same_pairs: bool = False
    against: str = ""

    @functools.cached_property
    def settings(self) -> dict[str, Setting]:
        """The settings by label."""
        return {one.label: one for one in self.study.settings}

    @functools.cached_property
    def labels(self) -> list[str]:
        """Labels of the settings that have episodes, in the study's order."""
        present = set(self.episodes["label"])
        return [label for label in self.study.labels if label in present]

    @property
    def absent(self) -> list[Episode]:
        """Episodes that the study asks for and that have not been stored yet."""
        present = set(self.episodes[["label", "task", "seed", "repeat"]].itertuples(index=False, name=None))
        return [one for one in self.study.episodes if (one.setting.label, *one.key[1:]) not in present]

    @functools.cached_property
    def references(self) -> dict[str, str]:
        """For each setting's label, the label of the setting that it is compared with (`references_of`)."""
        return references_of(self.study.settings, self.study.baseline)

    def compared_with(self, label: str) -> StudyData:
        """Return the study with the setting `label` as its baseline. Its tables are named NAME_against_LABEL.

        Raises:
            UsageError: The study has no such setting.
        """
        if label not in self.settings:
            raise UsageError(f"baseline={label}: '{self.study.name}' has the settings {', '.join(self.labels)}")
        against = f"_against_{re.sub(r'[^A-Za-z0-9.]+', '_', label)}"
        return replace(self, study=replace(self.study, baseline=label), against=against)

    @property
    def name(self) -> str:
        """Name of the study's tables."""
        return f"{self.study.name}{self.against}"

    @functools.cached_property
    def unstressed(self) -> dict[str, str]:
        """For each setting's label, the label of the same setting without stress.

        If the study does not run the setting without stress, the value is the label of the first setting that differs
        only in stress and `rollout.*`.
        """
        first: dict[str, str] = {}
        for setting in sorted(self.study.settings, key=_has_stress):
            first.setdefault(_methods_of(setting), setting.label)
        found = {}
        for setting in self.study.settings:
            found[setting.label] = first[_methods_of(setting)] if _has_stress(setting) else setting.label
        return found

    @functools.cached_property
    def pairs(self) -> pd.DataFrame:
        """Episodes of each setting, paired with those of the setting that it is compared with (`measures.paired`)."""
        return paired(self.episodes, self.references)

    @functools.cached_property
    def by_speed(self) -> list[tuple[str, stats.Estimate]]:
        """The timed settings, the fastest per episode first, each with its speed per episode against the next slower.

        The slowest has NaN. Empty if the settings are compared with several baselines, or if fewer than two were timed.
        """
        timed = [row for row in averaged(self.results) if is_number(row.speed)]
        order = [one.label for one in sorted(timed, key=attrgetter("speed"), reverse=True)]
        if len(order) < 2 or len(set(self.references.values())) > 1:
            return []
        next_ones = dict(itertools.pairwise(order))
        runs = [speedups(paired(run, next_ones), ["label"], MICRO) for run in self.runs or (self.episodes,)]
        return [(label, _over_runs(runs, label, self.same_pairs).episode_speedup) for label in order]

    @functools.cached_property
    def tallies(self) -> dict[str, Tally]:
        """How many draft tokens were accepted, for each setting that verified drafts. Reads all decodes."""
        episodes, tallies = self.episodes.groupby("label")["episode"], {}
        for label in self.labels:
            tally = tally_of(self.study, episodes.get_group(label).tolist())
            if tally is not None:
                tallies[label] = tally
        return tallies

    @functools.cached_property
    def results(self) -> list[Result]:
        """Two rows per setting: one pools all tasks (MICRO), one averages over difficulty groups (MACRO)."""
        return with_matched_speed([*_results(self, MICRO), *_results(self, MACRO)])

    @functools.cached_property
    def task_results(self) -> list[Result]:
        """One row per task and setting. Tasks are sorted by name, settings are in the study's order."""
        return with_matched_speed(_results(self, ONE_TASK))

    @functools.cached_property
    def latencies(self) -> pd.DataFrame:
        """The rows of settings whose world goes on during a decode (`latency_table`)."""
        return latency_table(self.results)

    @functools.cached_property
    def table(self) -> pd.DataFrame:
        """`results` as a data frame."""
        return frame_of(self.results)

    @functools.cached_property
    def per_task(self) -> pd.DataFrame:
        """`task_results` as a data frame."""
        return frame_of(self.task_results)


def references_of(settings: Sequence[Setting], baseline: str) -> dict[str, str]:
    """Return for each setting's label the label of the setting that it is compared with.

    That is the baseline's method under the same stress and clock, if the study has such a setting. Otherwise it is
    the study's baseline.

    Args:
        settings: The study's settings.
        baseline: Label of its baseline.
    """
    same: dict[str, str] = {}
    for own in settings:
        if own.label == baseline:
            for one in (*settings, own):
                if _methods_of(one) == _methods_of(own):
                    same[_conditions_of(one)] = one.label
    return {one.label: same.get(_conditions_of(one), baseline) for one in settings}


def _has_stress(setting: Setting) -> bool:
    """Return whether a setting disturbs the world."""
    return bool(stress_of(setting.settings)["level"])


def _conditions_of(setting: Setting) -> str:
    """Return a setting's stress and its settings `rollout.*` as JSON, to find settings under the same conditions."""
    return json.dumps([stress_of(setting.settings), setting.settings["rollout"]], sort_keys=True)


def _methods_of(setting: Setting) -> str:
    """Return everything that determines a setting's results, except stress and the settings `rollout.*`, as JSON."""
    world = without(setting.settings["world"], {"stress"})
    others = without(setting.settings, (NOT_DETERMINING - {"policy"}) | {"world", "rollout"})
    return json.dumps([world, others, dict(setting.identity)], sort_keys=True)


def load_study(study: Study, wanted: Sequence[Episode] | None = None) -> StudyData:
    """Read a study and its stored episodes.

    Args:
        study: The study. Its name is enough if `wanted` is None.
        wanted: Episodes to read. Settings without any of them are left out. None: read all episodes.

    Raises:
        UsageError: There is no such study, or none of its episodes is stored.
    """
    if wanted is None:
        study = study.load()
    else:
        labels = {one.setting.label for one in wanted}
        settings = tuple(setting for setting in study.settings if setting.label in labels)
        study = replace(study, settings=settings, episodes=tuple(wanted))
    frame = study.frame(wanted)
    if frame.empty:
        raise UsageError(f"study '{study.name}' has no episode yet: {study.how_to_run()}")
    whole = study.whole_runs() if wanted is None else []
    same_pairs = len(whole) > 2
    frames = [study.frame(run=run) for run in whole] if same_pairs else _with_new_seeds(frame)
    runs = [_labelled(study, run) for run in frames if _same_state(run, frame)]
    return StudyData(study, _labelled(study, frame), tuple(runs) if len(runs) > 2 else (), same_pairs)


def _same_state(run: pd.DataFrame, episodes: pd.DataFrame) -> bool:
    """Return whether a run and the study's episodes were computed by the same code on the same machine."""
    # imported episodes may lack some columns
    return all(set(run[name]) == set(episodes[name]) for name in _ONE_STATE if name in episodes)


def _with_new_seeds(episodes: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the episodes of each run, oldest first, if each run measured every setting in every task on its own seeds.

    Otherwise return an empty list.
    """
    runs = sorted((run for _, run in episodes.groupby("run")), key=lambda run: run["started"].min())
    groups = episodes["label"].nunique() * episodes["task"].nunique()
    seen: set[tuple[Any, ...]] = set()
    for run in runs:
        worlds = set(run[["task", "seed"]].itertuples(index=False, name=None))
        if len(run[["label", "task"]].drop_duplicates()) < groups or worlds & seen:
            return []
        seen |= worlds
    return runs


def _labelled(study: Study, episodes: pd.DataFrame) -> pd.DataFrame:
    """Add the columns difficulty, device, dtype and threads to the episodes."""
    added = {"difficulty": episodes["task"].map(functools.cache(difficulty_of))}
    for name in _RUNTIME:
        values = {setting.label: setting.settings["runtime"][name] for setting in study.settings}
        added[name] = episodes["label"].map(values)
    added["initial_state"] = episodes["initial_state"].map(tuple)  # tuples can be compared
    # strings as Python objects: these frames are cut into hundreds of small ones, and arrow's arrays are slow at that
    texts = ("label", "task", "block", "started", "device_name", "run", "difficulty", "device", "dtype")
    return episodes.assign(**added).astype(dict.fromkeys(texts, object))


def tally_of(study: Study, episodes: Sequence[int]) -> Tally | None:
    """Count the verifications of some episodes of one setting. None if their decodes verified no draft.

    Args:
        study: The study.
        episodes: Row numbers of the episodes.
    """
    total = None
    for first in range(0, len(episodes), _AT_ONCE):
        part = list(episodes[first : first + _AT_ONCE])
        rounds = study.decodes(part, ("rounds",))["rounds"].combine_chunks().flatten()
        is_verification = pc.and_(pc.greater(rounds.field("tree_size"), 0), pc.not_equal(rounds.field("mode"), "skip"))
        rounds = rounds.filter(is_verification)
        if not len(rounds):
            continue
        start, accepted, nodes = (rounds.field(name).to_numpy() for name in ("start", "accepted", "tree_size"))
        judged = pc.list_value_length(rounds.field("drafted")).to_numpy().astype(np.int64)
        dofs = len(rounds.field("threshold")[0])
        tally = Tally.of(start, judged, accepted, nodes, dofs)
        total = tally if total is None else total + tally
    return total


def difficulty_of(task: str) -> str:
    """Return the task's difficulty group, or `other` if no environment has the task."""
    for spec in specs().values():
        if task in spec.tasks:
            return spec.tasks[task].difficulty
    return "other"


def _results(data: StudyData, averaging: str) -> list[Result]:
    """Return a row per setting, or per task and setting, in the study's order.

    Args:
        data: The study.
        averaging: MICRO (pool all episodes), MACRO (average over difficulty groups) or ONE_TASK (a row for each task).
    """
    by = ["task", "label"] if averaging == ONE_TASK else ["label"]
    measured = measure(data.episodes, data.pairs, by, averaging)
    runs = [speedups(paired(run, data.references), by, averaging) for run in data.runs]
    indices = data.episodes.groupby(by).indices
    texts = data.episodes.reindex(columns=["task", "difficulty", "seed", "repeat", *_PROVENANCE]).astype(object)
    texts = texts.where(texts.notna(), None)

    def key_of(group: Any) -> tuple[str, str]:
        return group if averaging == ONE_TASK else ("", group)

    def order(group: Any) -> tuple[str, int]:
        task, label = key_of(group)
        return task, data.labels.index(label)

    results = []
    for group in sorted(indices, key=order):
        part, (_, label) = texts.iloc[indices[group]], key_of(group)
        measures = measured[group]
        if runs:
            measures = replace(measures, **_over_runs(runs, group, data.same_pairs)._asdict())
        setting = data.settings[label]
        stress = stress_of(setting.settings)
        hashes = {f"{name}_sha256": value for name, value in sorted(setting.identity.items()) if name != OBSERVATION}
        row = Result(
            study=data.name,
            averaging=averaging,
            label=label,
            series=_series_of(setting, data.study.axis),
            unstressed=data.unstressed[label],
            method=setting.settings["method"],
            task=_joined(sorted(part["task"].unique())),
            tasks=part["task"].nunique(),
            difficulty=_joined(sorted(part["difficulty"].unique())),
            seeds=seeds_text(part["seed"].unique()),
            repeats=part["repeat"].nunique(),
            episodes=len(part),
            baseline=data.references[label],
            measures=measures,
            runs=max(1, len(runs)),
            overrides=setting.overrides,
            settings=flatten(without(setting.settings, NOT_DETERMINING - {"policy"})),
            observation=setting.identity.get(OBSERVATION, ""),
            hashes=hashes,
            stress=stress["kind"],
            stress_level=stress["level"],
            provenance={name: _joined(part[name].unique()) for name in _PROVENANCE},
        )
        results.append(row)
    return results


def _over_runs(runs: Sequence[Mapping[Hashable, Speeds]], group: Hashable, same_pairs: bool) -> Speeds:
    """Return the speeds of a group over all runs (docs/methods.md §7).

    Args:
        runs: What `speedups` returned for each run.
        group: Key of the group in those results.
        same_pairs: Whether all runs measured the same pairs.
    """
    several = [run.get(group, Speeds()) for run in runs]
    if len(several) == 1:
        return several[0]
    over_runs = functools.partial(stats.over_runs, same_pairs=same_pairs)
    return Speeds(*map(over_runs, zip(*several, strict=True)))


def _series_of(setting: Setting, axis: str) -> str:
    """Return a name that settings share if they differ only along the study's axis."""
    words = [setting.name.rstrip(", ")]
    for key, value in setting.varies.items():
        if key != axis:
            words.append(f"{key.split('.')[-1]} {value}")
    return ", ".join(words)


def flatten(settings: Plain) -> Row:
    """Return nested settings as one dictionary with dotted keys, such as `threshold.r`.

    The values of a list become one text, separated by semicolons.
    """
    values = flat(settings)
    for key, value in values.items():
        if isinstance(value, list | tuple):
            values[key] = _joined(value)
    return values


def differences(first: Row, second: Row) -> list[tuple[str, Any, Any]]:
    """Return every key whose values differ, with both values. A value is None if that side does not have the key."""
    found = []
    for key in first | second:
        ours, theirs = first.get(key), second.get(key)
        if ours != theirs:
            found.append((key, ours, theirs))
    return found


def _joined(values: Iterable[object]) -> str:
    """Return all different values as one text, separated by semicolons. None is left out."""
    return ";".join(dict.fromkeys(str(value) for value in values if value is not None))


def split_values(texts: Iterable[object]) -> set[str]:
    """Split texts at semicolons and return all different values."""
    return set(";".join(map(str, texts)).split(";"))


def further_of(data: StudyData) -> dict[str, Any]:
    """Return the facts about a study that its CSV files leave out, as JSON values.

    Returns:
        A dictionary with the keys `study` (its name), `axis` (key of the plots' x axis) and `labels`. The last maps
        each setting's label to a dictionary:

        - `name`, `overrides` and `settings` of the setting
        - `varies`: values of the keys that differ within its grid (the settings that one entry of the study expands to)
        - `identity`: hashes of weights and data
        - `provenance`: executor, machine, versions and the like
        - `measures`: for each averaging and each task, the measures that have no column in the CSV files
        - `acceptance`: how many draft tokens were accepted, over all tasks; only if drafts were verified
    """
    labels: dict[str, Any] = {}
    for row in [*data.results, *data.task_results]:
        setting = data.settings[row.label]
        about = {
            "name": setting.name,
            "varies": dict(setting.varies),
            "overrides": setting.overrides,
            "settings": without(setting.settings, {"results", "task"}),
            "identity": dict(setting.identity),
            "provenance": {name: setting.settings["runtime"][name] for name in _RUNTIME} | dict(row.provenance),
            "measures": {},
        }
        labels.setdefault(row.label, about)["measures"][row.where] = _further_measures(row)
    for label, tally in data.tallies.items():
        labels[label]["acceptance"] = tally.as_dict()
    return {"study": data.name, "axis": data.study.axis, "labels": labels}


def _further_measures(row: Result) -> Row:
    """Return the measures of a row that have no column in the CSV files. NaN, which JSON cannot hold, is None."""
    values: Row = {"tasks": row.tasks, "difficulty": row.difficulty, "repeats": row.repeats}
    for name, value in columns_of(vars(row.measures)).items():
        if name not in CSV_COLUMNS:
            values[name] = None if isinstance(value, float) and not math.isfinite(value) else value
    return values


def is_stressed(results: Iterable[Result]) -> bool:
    """Return whether a study compares several kinds or levels of stress (disturbed worlds, docs/stress.md)."""
    return len(set(map(attrgetter("stress", "stress_level"), results))) > 1


def summed_table(results: Iterable[Result]) -> pd.DataFrame:
    """Pool a study's stressed episodes in three ways: by kind of stress, by level, and all together.

    Each pooled row is compared with the baseline's episodes in the same worlds under the same stresses.

    Returns:
        One row for each method and each way of pooling. `method` is the setting's label without stress. `sum` says what
        was pooled, such as `push`, `level 2` or `all`. `label` joins `method` and `sum`. The other columns are the same
        as in a study's table.
    """
    rows = [row for row in averaged(results) if row.stress != NO_STRESS]
    reference = next((row.unstressed for row in rows if row.is_baseline), "")
    kinds = dict.fromkeys(one.stress for one in rows)
    levels = dict.fromkeys(f"level {one.stress_level}" for one in rows)
    sums = []
    for name in (*sorted(kinds), *sorted(levels), "all"):
        methods: dict[str, list[Result]] = {}
        for row in rows:
            if name in (row.stress, f"level {row.stress_level}", "all"):
                methods.setdefault(row.unstressed, []).append(row)
        for method, pooled in methods.items():
            about = {"study": rows[0].study, "label": f"{method} {name}", "method": method, "sum": name}
            sums.append(columns_of({**about, "baseline": f"{reference} {name}", **_pooled(pooled)}))
    return pd.DataFrame(sums)


def _pooled(rows: Sequence[Result]) -> dict[str, Any]:
    """Return the success of several settings together, and how it compares with their baselines."""
    episodes, successes = sum(one.episodes for one in rows), sum(one.measures.successes for one in rows)
    counts = PairedCounts(*np.sum([one.measures.counts for one in rows], axis=0).tolist())
    success = {"episodes": episodes, "successes": successes, "success": stats.wilson(successes, episodes)}
    return success | compared(counts, stats.paired_difference(counts))


_LATENCY_COLUMNS = (
    "study", "label", "method", "ar", "rollout.clock", "rollout.latency", "rollout.latency_ms", "rollout.profile",
    "rollout.ar_ms", "rollout.delay_compensation", "rollout.batch", "ar_latency_ms", "episodes", "felt_latency_ms",
    "felt_latency_steps", "held_share", "forwards_per_step", "successes", "success", "success_low", "success_high",
    "pairs", "difference", "difference_low", "difference_high", "only_baseline", "only_method", "mcnemar_p",
    "prefill_draft.kind", "proposer.kind",
)  # fmt: skip


def latency_table(results: Iterable[Result]) -> pd.DataFrame:
    """Return the rows of settings whose world goes on during a decode (`rollout.clock=real`).

    A row is left out if the world of its baseline waits during decodes. The added column `ar_latency_ms` is the mean
    latency of the baseline's decodes.
    """
    rows = averaged(results)
    latencies = {row.label: row.measures.felt_latency_ms for row in rows}
    delayed = []
    for row in rows:
        of_baseline = latencies.get(row.baseline)
        if is_number(row.measures.felt_latency_ms) and is_number(of_baseline):
            delayed.append({**columns_of(vars(row)), "ar": row.baseline, "ar_latency_ms": of_baseline})
    return pd.DataFrame(delayed, columns=list(_LATENCY_COLUMNS))
