"""Compare two runs (`kerv runs compare`): which settings and tokens differ."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import pandas as pd

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.catalogue.entries import RunEntry, description_of, find_run, store_of
from kerv_cli.episodes.identity import NOT_DETERMINING, OBSERVATION, Setting, without
from kerv_cli.lab.database import Database
from kerv_cli.lab.plan import seeds_text
from kerv_cli.lab.read import decodes_of, loaded
from kerv_cli.report.measures import Row
from kerv_cli.report.tables import StudyData, differences, flatten, load_study, split_values

_PROVENANCE = ("host", "device_name", "git_commit", "torch_version", "mujoco_version", "kerv_version")


@dataclass
class ComparedRun:
    """One side of a comparison: a training, or one setting of a run that has episodes.

    Attributes:
        name: Name to print.
        label: Label of the setting in the run. Empty for a training.
        data: Episodes of the run. None before `pairs_to_compare` has read them, and for a training.
    """

    name: str
    run: RunEntry
    label: str = ""
    data: StudyData | None = None

    @property
    def episodes(self) -> pd.DataFrame:
        assert self.data is not None
        return self.data.episodes[self.data.episodes["label"] == self.label]

    @property
    def setting(self) -> Setting:
        assert self.data is not None
        return self.data.settings[self.label]


def compared_runs(database: Database, name: str) -> list[ComparedRun]:
    """Return what a name stands for: a training, all settings of a run (`ID`), or one (`ID:LABEL`)."""
    identifier, _, label = name.partition(":")
    run = find_run(database, identifier)
    if not run.has_episodes:
        if label:
            raise UsageError(f"{run.id} is a {run.kind}: it has no setting '{label}'")
        return [ComparedRun(run.id, run)]
    labels = loaded(store_of(run, database)).labels
    if not labels:
        raise UsageError(f"study {run.id} has no setting: remove it with 'kerv runs rm {run.id}'")
    if label and label not in labels:
        raise UsageError(f"run {run.id} has no setting '{label}': it has {', '.join(labels)}")
    if len(labels) == 1:
        return [ComparedRun(run.id, run, labels[0])]
    return [ComparedRun(f"{run.id}:{one}", run, one) for one in labels if label in ("", one)]


def pairs_to_compare(database: Database, first: str, second: str) -> list[tuple[ComparedRun, ComparedRun]]:
    """Return which settings of two runs (`ID` or `ID:LABEL`) to compare with each other: those with the same label.

    If the runs share fewer than two labels, the first run's first setting is compared with each of the second run's.
    """
    ours, theirs = compared_runs(database, first), compared_runs(database, second)
    if ours[0].run.has_episodes != theirs[0].run.has_episodes:
        raise UsageError(f"{ours[0].run.id} and {theirs[0].run.id} cannot be compared: only one of them has episodes")
    pairs = [(a, b) for a, b in itertools.product(ours, theirs) if a.label == b.label]
    if len(pairs) < 2 and not (pairs and len(ours) == len(theirs) == 1):
        pairs = [(ours[0], side) for side in theirs if side != ours[0]]
    data: dict[str, StudyData] = {}
    for side in itertools.chain.from_iterable(pairs):
        if side.run.has_episodes and side.run.id not in data:
            data[side.run.id] = load_study(store_of(side.run, database))
        side.data = data.get(side.run.id)
    return pairs


def compare(first: ComparedRun, second: ComparedRun) -> Row:
    """Return the differences between two settings or two trainings, as JSON values.

    `settings` has every key whose two values differ; a missing value is None. `tokens` says how many episodes have the
    same tokens. It is empty if these may differ.
    """
    settings = differences(_settings_of(first), _settings_of(second))
    return {"first": first.name, "second": second.name, "settings": settings, "tokens": _same_tokens(first, second)}


def _settings_of(side: ComparedRun) -> Row:
    if side.data is None:
        description = description_of(side.run)
        settings: Row = dict(description.get("settings", {}))
        for key in ("git_commit", "versions", "demos"):
            if key in description:
                settings[key] = description[key]
        return flatten(settings)
    setting, episodes = side.data.settings[side.label], side.episodes
    tasks, seeds = set(), []
    for one in side.data.study.episodes:
        if one.setting.label == side.label:
            tasks.add(one.task)
            seeds.append(one.seed)
    settings = flatten(without(setting.settings, NOT_DETERMINING - {"policy", "method"}))
    for name, value in without(setting.identity, {OBSERVATION}).items():
        settings[name] = value[:12]
    settings["tasks"] = ";".join(sorted(tasks))
    settings["seeds"] = seeds_text(seeds)
    for name in _PROVENANCE:
        if name in episodes:
            settings[name] = ";".join(sorted(split_values(episodes[name].dropna())))
    return settings


def _same_tokens(first: ComparedRun, second: ComparedRun) -> str:
    # empty if the two are of other settings, weights or versions of kerv's rules, so that tokens may differ
    if first.data is None or second.data is None or first.setting.work != second.setting.work:
        return ""
    both = _tokens(first).merge(_tokens(second), on=["task", "seed"])
    return f"the same tokens in {(both['tokens_x'] == both['tokens_y']).sum()} of {count(len(both), 'episode')}"


def _tokens(side: ComparedRun) -> pd.DataFrame:
    assert side.data is not None
    frame = side.episodes[["episode", "task", "seed"]].reset_index(drop=True)
    # `episode` of the decodes is a position in the list
    decodes = decodes_of(side.data.study, frame["episode"].tolist(), ["tokens"]).to_pandas()
    tokens = decodes.groupby("episode")["tokens"].agg(lambda rows: tuple(map(tuple, rows)))
    return frame.assign(tokens=tokens.reindex(range(len(frame))).to_list())
