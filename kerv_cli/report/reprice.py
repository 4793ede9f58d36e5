"""Estimate what a study's decodes would cost on another machine or with another target (docs/measuring.md).

The estimate assumes that each setting would decode the same tokens in the same control steps there. The costs are from
a profile: a file that `kerv bench` writes, with the seconds that each operation of a decode takes on a machine.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.episodes.cost import COUNTED, READ_PHASES, Profile, Work, prices, read_profile, work_of
from kerv_cli.lab.store import decodes_of
from kerv_cli.report.measures import Measures, Result, Row, columns_of, measure, paired, speedups
from kerv_cli.report.profiles import NamedProfile, open_profiles
from kerv_cli.report.tables import StudyData

# Columns of a decode that the cost model reads
READ = ("index", "rounds", "similarity", *map("seconds.{}".format, READ_PHASES))


@dataclass(frozen=True)
class Priced:
    """How fast a setting would be on another machine, estimated from a cost profile (written by `kerv bench`)."""

    result: Result  # the setting's row, as measured
    machine: NamedProfile
    measures: Measures  # the setting's measures, estimated for the machine
    # speeds per episode under other times of the vision encoder, by key of `ENCODERS`. Empty if its time is known.
    encoders: Mapping[str, float]


def prices_table(priced: Sequence[Priced]) -> list[Row]:
    rows, encoders = [], dict.fromkeys(itertools.chain.from_iterable(one.encoders for one in priced))
    for one in priced:
        result, of, measured = one.result, one.measures, one.result.measures
        row: Row = {"study": result.study, "label": result.label, "baseline": result.baseline, "on": one.machine.name}
        row |= {"machine": one.machine.title, "projected": one.machine.is_projected}
        row |= {"episode_speedup": of.episode_speedup, "speedup": of.speedup}
        row |= {"time_per_episode_ms": of.time_per_episode_ms, "time_per_step_ms": of.time_per_step_ms}
        row |= {"latency_p95_ms": of.latency_p95_ms, **{name: one.encoders.get(name) for name in encoders}}
        row |= {"measured_episode_speedup": measured.episode_speedup, "measured_speedup": measured.speedup}
        row |= {"measured_on": result.provenance["device_name"], "episodes": result.episodes, "pairs": of.pairs}
        rows.append(columns_of(row))
    return rows


def repriced(data: StudyData, profiles: Sequence[NamedProfile], lenient: bool = False) -> list[Priced]:
    """Estimate how fast every setting that decodes would be on the machine of each profile.

    Args:
        lenient: Leave out a profile that lacks a cost instead of raising an error.
    """
    if not profiles:
        return []
    here = data.episodes[data.episodes["server_decodes"].fillna(0) == 0]  # a server's phases are unknown
    decoded, works = here.groupby("label")[["forwards", "skipped_decodes"]].sum().any(axis=1), {}
    for label in data.labels:
        if decoded.get(label):
            works[label] = _work_of_label(data, label)
    rows = []
    for named in profiles if works else ():
        try:
            for label, work in works.items():
                named.check(work.size, work.work.needs, label)
        except UsageError:
            if lenient:
                continue
            raise
        estimated = _estimated(data, works, named.profile)
        encoders: dict[Hashable, dict[str, float]] = defaultdict(dict)
        for name, profile in named.encoders.items():
            for of, measures in _estimated(data, works, profile).items():
                encoders[of][name] = measures.episode_speedup.value
        found = [row for row in data.results if row.label in works]
        rows += [Priced(row, named, estimated[row.label], encoders[row.label]) for row in found]
    return rows


def _estimated(data: StudyData, works: Mapping[str, _LabelWork], profile: Profile) -> dict[Hashable, Measures]:
    episodes = data.episodes
    priced = pd.concat([_priced(episodes[episodes["label"] == label], work, profile) for label, work in works.items()])
    pairs = paired(priced, data.references)
    return measure(priced, pairs, speeds=speedups(pairs, all_pairs=True))


def own_profiles(data: StudyData, elsewhere: bool = True) -> list[NamedProfile]:
    """Return the cost profiles that `kerv bench` measured on the machines that ran the study.

    Estimates next to the measured times show how accurate the cost model is. Missing profiles are left out.

    Args:
        elsewhere: Whether to include the machines that the study's file names.
    """
    results, profiles = data.study.database.results, dict[str, NamedProfile]()
    for name in data.study.machines if elsewhere else ():
        with suppress(UsageError):
            (profiles[name],) = open_profiles(results, [name])
    devices = set(data.episodes["device_name"])
    for one in data.study.settings:
        target = str(one.settings["policy"]["target"]).rstrip("/").rsplit("/", 1)[-1]
        name = f"{target}-{one.settings['runtime']['dtype']}"
        with suppress(CheckpointError):
            profile = read_profile(results / "bench" / f"{name}.json")
            if profile.about.get("device_name") in devices:
                profiles.setdefault(name, NamedProfile(name, profile))
    return list(profiles.values())


class _LabelWork(NamedTuple):
    """The operations that each decode of a setting executed."""

    work: Work  # the forwards and drafts of each decode, and the recorded seconds of everything else
    episode: np.ndarray  # (decodes,) number of the decode's episode, from 0, in the order of the setting's episodes
    size: int  # N, number of tokens per chunk


def _work_of_label(data: StudyData, label: str) -> _LabelWork:
    episodes = data.episodes.loc[data.episodes["label"] == label, "episode"]
    table = decodes_of(data.study, episodes.tolist(), READ).combine_chunks()
    rounds = table["rounds"].combine_chunks()
    counts = pc.list_value_length(rounds).to_numpy(zero_copy_only=False).astype(np.int64)
    every = rounds.flatten()
    columns = {name: every.field(name).to_numpy(zero_copy_only=False) for name in (*COUNTED, "committed")}
    decode = np.repeat(np.arange(len(counts)), counts)
    size = int(np.bincount(decode, columns.pop("committed")).max())
    phases = {phase: np.nan_to_num(table[f"seconds.{phase}"].to_numpy()) for phase in READ_PHASES}
    looked_up = ~np.isnan(table["similarity"].to_numpy(zero_copy_only=False).astype(float))
    work = work_of(columns, counts, phases, looked_up, size)
    return _LabelWork(work, table["episode"].to_numpy(), size)


def _priced(episodes: pd.DataFrame, work: _LabelWork, profile: Profile) -> pd.DataFrame:
    """Return the episodes with estimates from a profile in the columns `seconds` and `decode_seconds`."""
    seconds = prices(work.work, profile)
    total = np.bincount(work.episode, seconds, len(episodes))
    order = np.argsort(work.episode, kind="stable")
    stops = np.cumsum(np.bincount(work.episode, minlength=len(episodes)))[:-1]
    return episodes.assign(seconds=total, decode_seconds=pd.Series(np.split(seconds[order], stops), episodes.index))
