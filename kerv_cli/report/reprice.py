"""Estimate what a study's decodes would cost on another machine or with another target (docs/measuring.md).

The estimate assumes that each setting would decode the same tokens in the same control steps there. The costs are from
a profile: a file that `kerv bench` writes, with the seconds that each operation of a decode takes on a machine.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.episodes.cost import COUNTED, READ_PHASES, Profile, Work, prices, read_profile, work_of
from kerv_cli.report.measures import MICRO, Measures, Result, Row, averaged, columns_of, measure, paired, speedups
from kerv_cli.report.profiles import NamedProfile, open_profiles
from kerv_cli.report.tables import StudyData

READ = ("index", "rounds", "similarity", *map("seconds.{}".format, READ_PHASES))
"""Columns of a decode that the cost model reads."""


@dataclass(frozen=True)
class Priced:
    """How fast a setting would be on another machine, estimated from a cost profile (written by `kerv bench`).

    Attributes:
        result: The setting's row of the study's table, as measured, pooled over tasks.
        machine: The cost profile of the other machine.
        measures: The measures of `result`, estimated for the machine.
        encoders: Speeds per episode, estimated under three further assumptions about the time of the vision encoder.
            The keys are those of `ENCODERS`. Empty if the profile was measured, so that the encoder's time is known.
    """

    result: Result
    machine: NamedProfile
    measures: Measures
    encoders: Mapping[str, float]


def prices_table(priced: Iterable[Priced]) -> pd.DataFrame:
    """Return the estimated speeds as a data frame: one row per machine and setting."""
    rows = []
    for one in priced:
        result, of, measured = one.result, one.measures, one.result.measures
        row: Row = {"study": result.study, "label": result.label, "baseline": result.baseline, "on": one.machine.name}
        row |= {"machine": one.machine.title, "projected": one.machine.is_projected}
        row |= {"episode_speedup": of.episode_speedup, "speedup": of.speedup}
        row |= {"time_per_episode_ms": of.time_per_episode_ms, "time_per_step_ms": of.time_per_step_ms}
        row |= {"latency_p95_ms": of.latency_p95_ms, "encoders": one.encoders}
        row |= {"measured_episode_speedup": measured.episode_speedup, "measured_speedup": measured.speedup}
        row |= {"measured_on": result.provenance["device_name"], "episodes": result.episodes, "pairs": of.pairs}
        rows.append(columns_of(row))
    return pd.DataFrame(rows)


def repriced(data: StudyData, profiles: Sequence[NamedProfile], lenient: bool = False) -> list[Priced]:
    """Estimate how fast every setting would be on the machine of each profile.

    Args:
        data: The study's episodes.
        profiles: For each machine, the seconds that each operation of a decode takes there (`kerv bench`).
        lenient: Leave out a profile that lacks a cost, instead of raising an error.

    Returns:
        One estimate per profile and setting. Settings that run no decoder are left out.

    Raises:
        UsageError: A profile lacks a cost that the study needs, or has costs for shorter chunks only. Or a setting has
            no times, because its episodes ran in a batch.
    """
    if not profiles:
        return []
    decoded, works = data.episodes.groupby("label")[["forwards", "skipped_decodes"]].sum().any(axis=1), {}
    for label in data.labels:
        if decoded[label]:
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
        found = [row for row in averaged(data.results) if row.label in works]
        rows += [Priced(row, named, estimated[row.label], encoders[row.label]) for row in found]
    return rows


def _estimated(data: StudyData, works: Mapping[str, _LabelWork], profile: Profile) -> dict[Hashable, Measures]:
    """Return the measures of every setting, by label. The times of the decodes are computed from a profile."""
    episodes = data.episodes
    priced = pd.concat([_priced(episodes[episodes["label"] == label], work, profile) for label, work in works.items()])
    pairs = paired(priced, data.references)
    return measure(priced, pairs, MICRO, speedups(pairs, all_pairs=True))


def own_prices(data: StudyData, elsewhere: bool = True) -> list[Priced]:
    """Return the study's speeds, estimated for the machines that the study's file names and for those that ran it.

    For a machine that ran the study, this needs a profile that `kerv bench` measured on that machine. Comparing such
    estimates with the measured times shows how accurate the cost model is. A profile that is missing or lacks a cost
    is left out.

    Args:
        data: The study's episodes.
        elsewhere: Whether to estimate for the machines that the study's file names, too.
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
    with suppress(UsageError):
        return repriced(data, list(profiles.values()), lenient=True)
    return []


class _LabelWork(NamedTuple):
    """The operations that each decode of a setting executed.

    Attributes:
        work: The forwards and drafts of each decode, and the recorded seconds of everything else.
        episode: (decodes,) number of the decode's episode, from 0, in the order of the setting's episodes.
        size: N, number of tokens per chunk.
    """

    work: Work
    episode: np.ndarray
    size: int


def _work_of_label(data: StudyData, label: str) -> _LabelWork:
    """Read which operations the decodes of a setting executed, in the order of its episodes.

    Raises:
        UsageError: The setting's episodes ran in a batch and have no times.
    """
    setting = data.settings[label]
    if (batch := setting.batch) > 1:
        raise UsageError(
            f"setting '{label}' ran {batch} episodes at a time, without times: run it with rollout.batch=1"
        )
    episodes = data.episodes.loc[data.episodes["label"] == label, "episode"]
    table = data.study.decodes(episodes.tolist(), READ).combine_chunks()
    rounds = table["rounds"].combine_chunks()
    counts = pc.list_value_length(rounds).to_numpy(zero_copy_only=False).astype(np.int64)
    every = rounds.flatten()
    columns = {}
    for name in (*COUNTED, "committed"):
        if every.type.get_field_index(name) >= 0:  # rounds had no levels before
            columns[name] = every.field(name).to_numpy(zero_copy_only=False)
    decode = np.repeat(np.arange(len(counts)), counts)
    size = int(np.bincount(decode, columns.pop("committed")).max())
    phases = {phase: np.nan_to_num(table[f"seconds.{phase}"].to_numpy()) for phase in READ_PHASES}
    looked_up = ~np.isnan(table["similarity"].to_numpy(zero_copy_only=False).astype(float))
    drafted = levels_of(setting.settings)
    levels = columns.get("levels", np.full(len(decode), np.nan)).astype(float)
    columns["levels"] = np.where(np.isnan(levels), drafted, levels).astype(int)
    work = work_of(columns, counts, phases, looked_up, size)
    return _LabelWork(work, table["episode"].to_numpy(), size)


def levels_of(settings: Mapping[str, Any]) -> int:
    """Return the number of levels of the trees that a setting drafts. It is 0 if the setting drafts no trees.

    It is needed for episodes of older versions of kerv, whose stored rounds do not have this number.
    """
    proposer = settings.get("proposer", {})
    return int(proposer["depth"]) if proposer.get("shape") == "tree" else 0


def _priced(episodes: pd.DataFrame, work: _LabelWork, profile: Profile) -> pd.DataFrame:
    """Return the episodes with the times that their decodes would take at the profile's costs.

    The columns `seconds` (sum over all decodes) and `decode_seconds` (array with one number per decode) are replaced.
    """
    seconds = prices(work.work, profile)
    total = np.bincount(work.episode, seconds, len(episodes))
    order = np.argsort(work.episode, kind="stable")
    stops = np.cumsum(np.bincount(work.episode, minlength=len(episodes)))[:-1]
    return episodes.assign(seconds=total, decode_seconds=pd.Series(np.split(seconds[order], stops), episodes.index))
