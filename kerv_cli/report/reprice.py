"""Estimate what a study's decodes would cost on another machine or with another target (docs/measuring.md).

The estimate assumes that each setting would decode the same tokens in the same control steps there. It reads the costs
from a profile: a file of `kerv bench` with the seconds that each operation of a decode takes on a machine.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.engine.cost import COUNTED, READ_PHASES, Profile, Work, prices, read_profile, work_of
from kerv_cli.report.measures import measure, paired
from kerv_cli.report.profiles import ENCODERS, NamedProfile, open_profiles
from kerv_cli.report.results import Measures, Result, Row, averaged, columns_of
from kerv_cli.report.summary import interval
from kerv_cli.report.tables import StudyData

ASSUMES = (
    "Speed against the baseline by the cost model: the recorded decodes at a profile's costs, as if the other machine "
    "and target decoded the same tokens in the same control steps; success is the recorded policy's"
)
_COLUMNS = ("index", "rounds", "similarity", *(f"seconds.{phase}" for phase in READ_PHASES))


@dataclass(frozen=True)
class Priced:
    """How fast a setting would be on another machine, estimated from a cost profile (file of `kerv bench`).

    Attributes:
        result: The setting's row as measured, pooled over tasks.
        machine: The cost profile of the other machine.
        measures: The measures of `result`, estimated for the machine.
        encoders: Estimated speeds per episode with other times of the vision encoder, by the keys of `ENCODERS`. Empty
            for measured profiles.
    """

    result: Result
    machine: NamedProfile
    measures: Measures
    encoders: Mapping[str, float]

    @property
    def columns(self) -> Row:
        """The setting's row in `prices_table`."""
        result, of, measured = self.result, self.measures, self.result.measures
        machine = {"on": self.machine.name, "machine": self.machine.title, "projected": self.machine.is_projected}
        speeds = {"episode_speedup": of.episode_speedup, "speedup": of.speedup}
        times = {name: getattr(of, name) for name in ("time_per_episode_ms", "time_per_step_ms", "latency_p95_ms")}
        before: Row = {"measured_episode_speedup": measured.episode_speedup, "measured_speedup": measured.speedup}
        before["measured_on"] = result.provenance["device_name"]
        about = {"study": result.study, "label": result.label, "baseline": result.baseline, **machine}
        counts = {"episodes": result.episodes, "pairs": of.pairs}
        return columns_of({**about, **speeds, **times, **self.encoders, **before, **counts})


def prices_table(priced: Iterable[Priced]) -> pd.DataFrame:
    """Return the estimated speeds as a data frame: one row per machine and setting."""
    return pd.DataFrame([one.columns for one in priced])


def repriced(data: StudyData, profiles: Sequence[NamedProfile], lenient: bool = False) -> list[Priced]:
    """Estimate how fast every setting would be on the machine of each profile.

    Args:
        data: The study's episodes.
        profiles: For each machine, the seconds that each operation of a decode takes there (`kerv bench`).
        lenient: Leave out a profile that lacks a cost, instead of refusing it.

    Returns:
        One row per profile and setting. Settings that run no decoder are left out.

    Raises:
        UsageError: A profile lacks a cost that the study needs, or has costs for shorter chunks only. Or a setting has
            no times, because its episodes ran in a batch.
    """
    if not profiles:
        return []
    decoded = data.episodes.groupby("label")[["forwards", "skipped_decodes"]].sum().any(axis=1)
    works = {label: _work_of_label(data, label) for label in data.labels if decoded[label]}
    if not works:
        return []
    rows = []
    for named in profiles:
        try:
            for label, work in works.items():
                named.check(work.size, work.work.needs, label)
        except UsageError:
            if lenient:
                continue
            raise
        estimated = _estimated(data, works, named.profile)
        encoders = {name: _estimated(data, works, profile) for name, profile in named.encoders.items()}
        for result in averaged(data.results):
            if result.label in works:
                speeds = {name: of[result.label].episode_speedup.value for name, of in encoders.items()}
                rows.append(Priced(result, named, estimated[result.label], speeds))
    return rows


def _estimated(data: StudyData, works: Mapping[str, _LabelWork], profile: Profile) -> dict[Hashable, Measures]:
    """Return the measures of every setting, by its label, with the times of its decodes computed from a profile."""
    episodes = data.episodes
    priced = pd.concat([_priced(episodes[episodes["label"] == label], work, profile) for label, work in works.items()])
    return measure(priced, paired(priced, data.references), all_pairs=True)


def own_prices(data: StudyData) -> list[Priced]:
    """Return the study's speeds, estimated for the machines that the study's file names.

    If `kerv bench` has measured the machine that ran the study, the estimates for that machine follow.
    """
    return prices_on(data, dict.fromkeys((*data.study.machines, *own_profiles(data))))


def prices_on(data: StudyData, names: Iterable[str]) -> list[Priced]:
    """Return the estimates of `repriced` for several machines. Empty without usable profiles or times.

    Args:
        data: The study's episodes.
        names: Names of cost profiles. A profile that is missing or lacks a cost is left out.
    """
    profiles = []
    for name in names:
        with suppress(UsageError):
            profiles += open_profiles(data.study.database.results, [name])
    with suppress(UsageError):
        return repriced(data, profiles, lenient=True)
    return []


def own_profiles(data: StudyData) -> list[str]:
    """Return the names of the cost profiles of the study's targets that were measured on the study's own machines.

    Comparing estimates from these profiles with the measured times shows how accurate the cost model is.
    """
    devices, names = set(data.episodes["device_name"]), []
    for one in data.settings.values():
        policy, runtime = one.settings.get("policy", {}), one.settings.get("runtime", {})
        target = str(policy.get("target")).rstrip("/").rsplit("/", 1)[-1]
        name = f"{target}-{runtime.get('dtype')}"
        with suppress(CheckpointError):
            profile = read_profile(data.study.database.results / "bench" / f"{name}.json")
            if profile.about.get("device_name") in devices:
                names.append(name)
    return names


class _LabelWork(NamedTuple):
    """Operations that all decodes of a setting executed.

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
    table = data.study.decodes(episodes.tolist(), _COLUMNS).combine_chunks()
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
    """Return the number of levels of the trees that a setting drafts. 0: the setting drafts chains.

    This is needed for episodes of older versions of kerv, whose stored rounds do not have this number.
    """
    proposer = settings.get("proposer", {})
    return int(proposer["depth"]) if proposer.get("shape") == "tree" else 0


def _priced(episodes: pd.DataFrame, work: _LabelWork, profile: Profile) -> pd.DataFrame:
    """Return the episodes with the times that their decodes would take at the profile's costs.

    The columns `seconds` (of all decodes) and `decode_seconds` (of each decode) are replaced.
    """
    seconds = prices(work.work, profile)
    total = np.bincount(work.episode, seconds, len(episodes))
    order = np.argsort(work.episode, kind="stable")
    stops = np.cumsum(np.bincount(work.episode, minlength=len(episodes)))[:-1]
    return episodes.assign(seconds=total, decode_seconds=pd.Series(np.split(seconds[order], stops), episodes.index))


def repriced_summary(priced: Sequence[Priced]) -> pd.DataFrame:
    """Return a table of speeds to print: one row per setting.

    Two columns hold the measured speeds. Two more columns per machine hold the estimated speeds. If the machine's
    profile was computed, a third column holds the speeds with other times of the vision encoder, see `ENCODERS`.
    """
    rows: dict[str, dict[str, str]] = {}
    for row in priced:
        machine, is_baseline = row.machine.title, row.result.is_baseline
        cells = rows.setdefault(row.result.label, {"setting": row.result.label})
        measured = f"measured, {row.result.provenance['device_name']}"
        for source, of in ((measured, row.result.measures), (machine, row.measures)):
            cells[f"{source}: per episode"] = "1×" if is_baseline else interval(of.episode_speedup, unit="×")
            cells[f"{source}: per step"] = "1×" if is_baseline else interval(of.speedup, unit="×")
        if row.encoders:
            heading = f"{machine}: per episode, if the encoder takes {', '.join(ENCODERS.values())}"
            texts = ["1"] * len(ENCODERS) if is_baseline else [f"{speed:.2f}" for speed in row.encoders.values()]
            cells[heading] = f"{' / '.join(texts)}×"
    return pd.DataFrame(rows.values())
