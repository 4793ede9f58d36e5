"""Read a study's stored episodes, and compute its tables: over all tasks and per task."""

from __future__ import annotations

import functools
import itertools
import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import pandas as pd

from kerv_cli.base.errors import UsageError
from kerv_cli.episodes.identity import NOT_DETERMINING, OBSERVATION, Plain, Setting, flat, stress_of, without
from kerv_cli.lab.plan import Episode, seeds_text
from kerv_cli.lab.store import Study, decodes_of, frame_of, how_to_run, loaded, whole_runs
from kerv_cli.report.measures import (
    OVERALL,
    PER_TASK,
    Result,
    Row,
    Speeds,
    is_number,
    measure,
    paired,
    speedups_of_runs,
)
from kerv_cli.report.statistics import Estimate
from kerv_cli.report.tally import READ, Tally
from kerv_cli.targets.provenance import PACKAGES
from kerv_cli.worlds import specs

RUNTIME = ("device", "dtype", "threads")
_PROVENANCE = (
    "workers", "device_name", "host", *map("{}_version".format, PACKAGES), "python_version",
    "git_commit", "engine", "run", "load",
)  # fmt: skip


# Smallest success rate at which the baseline counts as solving its tasks
SOLVED = 0.20
NO_STRESS = "none"
_AT_ONCE = 200  # episodes in memory at a time
# Episodes of a setting whose decodes are read, to count accepted tokens by position and DoF
MOST_TALLIED = 500
NO_TALLY = Tally.of_records((), 0)
# Columns in which runs must agree. Otherwise their speeds are not averaged.
_ONE_STATE = ("engine", "git_commit", "device_name")


@dataclass(frozen=True)
class StudyData:
    """A study (settings that are compared) with its stored episodes. Tables are computed on first use and then kept."""

    study: Study
    # one row per stored episode. Columns as in `frame_of`, then device, number format, threads.
    episodes: pd.DataFrame
    # one table like `episodes` per run (command), all of the same code on the same kind of device. Empty if there are
    # fewer than three.
    runs: tuple[pd.DataFrame, ...] = ()
    # whether each run measured all episodes of the study. If not, each measured all settings and tasks, on seeds that
    # no other run used.
    same_pairs: bool = False
    # suffix of the names of tables and page, such as `_against_ar`. Empty for the study's own baseline.
    against: str = ""

    @functools.cached_property
    def settings(self) -> dict[str, Setting]:
        return dict(zip(self.study.labels, self.study.settings, strict=True))

    @functools.cached_property
    def labels(self) -> list[str]:
        present = set(self.episodes["label"])
        return [label for label in self.study.labels if label in present]

    @functools.cached_property
    def absent(self) -> list[Episode]:
        """Episodes that the study asks for and that are not stored yet."""
        if len(self.episodes) == len(self.study.episodes):
            return []
        present = set(self.episodes[["label", "task", "seed"]].itertuples(index=False, name=None))
        return [one for one in self.study.episodes if (one.setting.label, *one.key[1:]) not in present]

    @functools.cached_property
    def references(self) -> dict[str, str]:
        return references_of(self.study.settings, self.study.baseline)

    def compared_with(self, label: str) -> StudyData:
        if label not in self.settings:
            raise UsageError(f"baseline={label}: '{self.study.name}' has the settings {', '.join(self.labels)}")
        against = f"_against_{re.sub(r'[^A-Za-z0-9.]+', '_', label)}"
        return replace(self, study=replace(self.study, baseline=label), against=against)

    @property
    def name(self) -> str:
        return f"{self.study.name}{self.against}"

    @functools.cached_property
    def unstressed(self) -> dict[str, str]:
        """For each setting's label, the label of the same setting without stress.

        If the study lacks that setting, it is the first one that differs only in stress and `rollout.*`.
        """
        first, same, found = dict[str, str](), dict[str, str](), {}
        for setting in sorted(self.study.settings, key=lambda one: stress_of(one.settings)["level"] > 0):
            methods, is_stressed = _methods_of(setting), stress_of(setting.settings)["level"] > 0
            clock = json.dumps([methods, setting.settings["rollout"]], sort_keys=True)
            usual = first.setdefault(methods, setting.label)
            same |= {} if is_stressed else {clock: setting.label}
            found[setting.label] = same.get(clock, usual) if is_stressed else setting.label
        return found

    @functools.cached_property
    def pairs(self) -> pd.DataFrame:
        return paired(self.episodes, self.references)

    @functools.cached_property
    def pairs_of_runs(self) -> list[pd.DataFrame]:
        return [paired(run, self.references) for run in self.runs] or [self.pairs]

    @functools.cached_property
    def by_speed(self) -> list[tuple[str, Estimate]]:
        """The timed settings, the fastest first, each with its speed per episode relative to the next slower one.

        Empty if the settings are compared with several baselines, or if fewer than two were timed.
        """
        timed = [row for row in self.results if is_number(row.speed)]
        if len(timed) < 2 or len(set(self.references.values())) > 1:
            return []
        labels = list(map(attrgetter("label"), sorted(timed, key=attrgetter("speed"), reverse=True)))
        next_ones = dict(itertools.pairwise(labels))
        runs = [paired(run, next_ones) for run in self.runs or (self.episodes,)]
        speeds = speedups_of_runs(runs, OVERALL, self.same_pairs)
        return [(label, speeds.get(label, Speeds()).episode_speedup) for label in labels]

    @functools.cached_property
    def tallies(self) -> dict[str, Tally]:
        """How many draft tokens each setting accepted, over its first `MOST_TALLIED` seeds."""
        tallies = {}
        for label in self.labels:
            own = self.episodes[self.episodes["label"] == label]
            if not own["verifications"].any():
                continue
            numbers, tally = own.sort_values("seed", kind="stable")["episode"].tolist()[:MOST_TALLIED], NO_TALLY
            for first in range(0, len(numbers), _AT_ONCE):
                decodes = decodes_of(self.study, numbers[first : first + _AT_ONCE], READ)
                tally += Tally.of_rounds(decodes["rounds"].combine_chunks().flatten())
            if tally.drafts:  # a server counts its verifications, but sends no rounds
                tallies[label] = tally
        return tallies

    @functools.cached_property
    def results(self) -> list[Result]:
        return _results(self, OVERALL)

    @functools.cached_property
    def task_results(self) -> list[Result]:
        return _results(self, PER_TASK)

    @property
    def varied(self) -> list[str]:
        keys = dict.fromkeys(itertools.chain.from_iterable(one.varies for one in self.study.settings))
        return list(keys | ({self.study.axis: None} if "." in self.study.axis else {}))


def references_of(settings: Sequence[Setting], baseline: str) -> dict[str, str]:
    """Return for each setting's label the label of the setting that it is compared with.

    That is the baseline's method under the setting's own conditions (stress and `rollout.*`, such as the clock), if the
    study has it. Otherwise it is the study's baseline.
    """
    same: dict[str, str] = {}
    for own in settings:
        if own.label == baseline:
            for one in (*settings, own):
                if _methods_of(one) == _methods_of(own):
                    same[_conditions_of(one)] = one.label
    return {one.label: same.get(_conditions_of(one), baseline) for one in settings}


def _conditions_of(setting: Setting) -> str:
    return json.dumps([stress_of(setting.settings), setting.settings["rollout"]], sort_keys=True)


def _methods_of(setting: Setting) -> str:
    world = without(setting.settings["world"], {"stress"})
    others = without(setting.settings, (NOT_DETERMINING - {"policy"}) | {"world", "rollout"})
    return json.dumps([world, others, dict(setting.identity)], sort_keys=True)


def load_study(study: Study, wanted: Sequence[Episode] | None = None) -> StudyData:
    """Read a study and its stored episodes.

    Args:
        study: If `wanted` is None, only its name matters: its settings and episodes are read again.
        wanted: Episodes to read. Settings without any of them are left out.
    """
    if wanted is None:
        study = loaded(study)
    else:
        labels = set(map(attrgetter("setting.label"), wanted))
        settings = tuple(setting for setting in study.settings if setting.label in labels)
        study = replace(study, settings=settings, episodes=tuple(wanted))
    frame = frame_of(study, wanted)
    if frame.empty:
        raise UsageError(f"study '{study.name}' has no episode yet: {how_to_run(study)}")
    whole = whole_runs(study) if wanted is None else []
    same_pairs = len(whole) > 2
    frames = [frame_of(study, run=run) for run in whole] if same_pairs else _with_new_seeds(frame)
    states = {name: set(frame[name].unique()) for name in frame.columns.intersection(list(_ONE_STATE))}
    runs = [_labelled(study, run) for run in frames if all(set(run[name].unique()) == states[name] for name in states)]
    return StudyData(study, _labelled(study, frame), tuple(runs) if len(runs) > 2 else (), same_pairs)


def _with_new_seeds(episodes: pd.DataFrame) -> list[pd.DataFrame]:
    """Return one table per run, the oldest first. Empty if a run lacks a setting on a task.

    Commands that ran episodes of the same seed count as one run, which was interrupted and resumed.
    """
    run, before = episodes["run"], None
    while before is None or not run.equals(before):
        before = run
        for shared in ("seed", "run"):
            run = run.groupby(episodes[shared]).transform("max")
    cells = episodes.assign(run=run)[["run", "label", "task"]].drop_duplicates()
    if (cells.groupby("run").size() < cells["label"].nunique() * cells["task"].nunique()).any():
        return []
    return sorted((part for _, part in episodes.groupby(run)), key=lambda part: part["started"].min())


def _labelled(study: Study, episodes: pd.DataFrame) -> pd.DataFrame:
    runtimes = pd.DataFrame([one.settings["runtime"] for one in study.settings], study.labels, list(RUNTIME))
    labelled = episodes.join(runtimes, on="label")
    # strings as Python objects: these frames are cut into hundreds of small ones, and arrow's arrays are slow at that
    names: list[str] = labelled.select_dtypes("str").columns.tolist()
    return labelled.astype(dict.fromkeys(names, "category")).astype(dict.fromkeys(names, object))


def dof_names(task: str, number: int) -> Sequence[str]:
    """Return the names of the DoFs of a task's actions. They are 0, 1, … if no environment here has the task."""
    for spec in specs().values():
        if task in spec.tasks and len(spec.actions.names) == number:
            return spec.actions.names
    return list(map(str, range(number)))


def _results(data: StudyData, by: Sequence[str]) -> list[Result]:
    speeds = speedups_of_runs(data.pairs_of_runs, by, data.same_pairs)
    measures = measure(data.episodes, data.pairs, by, speeds)
    texts = data.episodes.reindex(columns=["label", "task", "seed", *_PROVENANCE])
    texts = texts.astype(object).where(texts.notna(), None)
    shared = {name: _joined(texts[name].unique()) for name in _PROVENANCE if texts[name].nunique(dropna=False) == 1}
    where = texts["task"] if by == PER_TASK else pd.Series("", texts.index)
    groups: Any = texts.groupby([where, pd.Categorical(texts["label"], data.labels)], observed=True)
    results = []
    for (task, label), part in groups:
        setting = data.settings[label]
        stress = stress_of(setting.settings)
        hashes = {f"{name}_sha256": value for name, value in sorted(setting.identity.items()) if name != OBSERVATION}
        row = Result(
            study=data.name,
            label=label,
            series=_series_of(setting, data.study.axis),
            unstressed=data.unstressed[label],
            method=setting.settings["method"],
            where=task,
            task=_joined(sorted(set(part["task"]))),
            tasks=part["task"].nunique(),
            seeds=seeds_text(part["seed"].unique()),
            episodes=len(part),
            baseline=data.references[label],
            measures=measures[(task, label) if task else label],
            runs=len(data.pairs_of_runs),
            overrides=" ".join(setting.overrides),
            settings=flatten(without(setting.settings, NOT_DETERMINING - {"policy"})),
            observation=setting.identity.get(OBSERVATION, ""),
            hashes=hashes,
            stress=stress["kind"],
            stress_level=stress["level"],
            provenance={name: shared.get(name) or _joined(part[name].unique()) for name in _PROVENANCE},
        )
        results.append(row)
    return results


def safety(row: Result) -> tuple[float, float]:
    """Return a key that sorts settings, the safest first. Success does not influence it.

    Fewer unverified tokens (in whole per cent) are safer, then more forwards per step. Settings that decode nothing
    come last.
    """
    unverified = row.measures.unverified_share
    return (1.0 if math.isnan(unverified) else round(unverified, 2), -row.measures.forwards_per_step)


def passing(rows: Iterable[Result], loss: float) -> list[Result]:
    """Test, in order, whether each setting loses less than `loss`. Return the rows before the first failed test.

    All tests together have the error rate of one test, because testing stops at the first failure (fixed-sequence
    testing).

    Args:
        loss: Largest acceptable loss of success, as a share of episodes.
    """
    return list(itertools.takewhile(lambda row: row.measures.difference.low > -loss, rows))


def _series_of(setting: Setting, axis: str) -> str:
    words = [setting.name.rstrip(", ")]
    for key, value in setting.varies.items():
        if key != axis:
            words.append(f"{key.split('.')[-1]} {value}")
    return ", ".join(words)


def flatten(settings: Plain) -> Row:
    """Return nested settings with dotted keys, such as `threshold.r`. Lists become text, joined by `;`."""
    return {key: _joined(one) if isinstance(one, list | tuple) else one for key, one in flat(settings).items()}


def _joined(values: Iterable[object]) -> str:
    return ";".join(dict.fromkeys(str(value) for value in dict.fromkeys(values) if value is not None))
