"""A study's decodes at the costs of another machine and target: what each setting would cost there if it decoded the
same tokens in the same control steps (docs/measuring.md)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.places import as_path, shipped_dir
from kerv_cli.engine.cost import READ_PHASES, Profile, Work, prices, read_profile, work_of
from kerv_cli.episodes.identity import batch_of
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.measures import MICRO, Row, decodes, measure
from kerv_cli.report.summary import SPEEDS
from kerv_cli.report.tables import StudyData, rows_of
from kerv_cli.report.text import compared, intervals

ASSUMES = (
    "Speed against the baseline by the cost model: the recorded decodes at a profile's costs, as if the other machine "
    "and target decoded the same tokens in the same control steps; success is the recorded policy's"
)
_COLUMNS = ("index", "rounds", "similarity", *(f"seconds.{phase}" for phase in READ_PHASES))
_SHIPPED = "-profile.json"
_ROUND = ("mode", "proposer", "start", "tree_size", "accepted")
_TIMES = ("time_per_episode_ms", "time_per_step_ms", "latency_p95_ms")


@dataclass(frozen=True)
class NamedProfile:
    """A profile, and the name in `on` that chose it."""

    name: str
    profile: Profile

    @property
    def title(self) -> str:
        """Target and device; of a projection, that nobody measured it."""
        about = self.profile.about
        names = [str(about[key]) for key in ("target", "device_name") if about.get(key)]
        return ", ".join(names or [self.name]) + (", projected" if about.get("projected") else "")


def open_profiles(results: Path | str, names: Iterable[str]) -> list[NamedProfile]:
    """The profiles of these names: paths, documents in <results>/bench, or those that kerv ships.

    Raises:
        UsageError: no such document, one without a profile, or one of another kerv.
    """
    folders = (Path(results) / "bench", shipped_dir().parent / "bench")
    profiles = []
    for name in names:
        paths = (as_path(name), *(folder / f"{name}{end}" for folder in folders for end in (".json", _SHIPPED)))
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            shipped = sorted({p.name.removesuffix(_SHIPPED) for folder in folders for p in folder.glob(f"*{_SHIPPED}")})
            raise UsageError(
                f"on={name}: no such profile, make one with 'kerv bench target=TARGET'"
                + (f", or take one of {', '.join(shipped)}" if shipped else "")
            )
        try:
            profiles.append(NamedProfile(name, read_profile(path)))
        except CheckpointError as error:
            raise UsageError(f"on={name}: {error}") from error
    return profiles


def repriced_table(data: StudyData, store: StudyStore, profiles: Sequence[NamedProfile]) -> pd.DataFrame:
    """One row per machine and label, pooled over tasks: speeds against the baseline there, per episode and per control
    step, with their intervals; times; and the speeds as they were measured.

    Raises:
        UsageError: a profile lacks a cost that the study needs, or is of chunks of another length; a setting has no
            times of its own.
    """
    episodes = {str(label): group for label, group in data.episodes.groupby("label", sort=False)}
    labels = [label for label in data.labels if decodes(episodes[label])]
    works = {label: _label_work(data, label, store) for label in labels}
    rows = []
    for named in profiles:
        _check(named, works)
        priced = {label: _priced(episodes[label], works[label], named.profile) for label in labels}
        for label in labels:
            reference = data.references[label]
            baseline = priced[reference] if reference in priced else priced[label].iloc[:0]
            values = measure(priced[label], baseline, MICRO, apart=True)
            measured = measure(episodes[label], episodes.get(reference, episodes[label].iloc[:0]), MICRO)
            rows.append(
                {
                    "study": data.study.name,
                    "label": label,
                    "baseline": reference,
                    "on": named.name,
                    "machine": named.title,
                    "projected": bool(named.profile.about.get("projected")),
                    **_speeds(values, ""),
                    **{name: values[name] for name in _TIMES},
                    **_speeds(measured, "measured_"),
                    "measured_on": ";".join(dict.fromkeys(episodes[label]["device_name"])),
                    "episodes": len(episodes[label]),
                    "pairs": values["pairs"],
                }
            )
    return pd.DataFrame(rows)


def _speeds(values: Row, prefix: str) -> dict[str, float]:
    return {f"{prefix}{name}{end}": values[f"{name}{end}"] for name in SPEEDS for end in ("", "_low", "_high")}


@dataclass(frozen=True)
class LabelWork:
    """The work of a label's decodes. episode: (decodes,) row of the label's episodes that each belongs to. size: N."""

    work: Work
    episode: np.ndarray
    size: int


def _label_work(data: StudyData, label: str, store: StudyStore) -> LabelWork:
    """Return the decodes of a label, in the order of its episodes."""
    setting = data.settings[label]
    if (batch := batch_of(setting.settings)) > 1:
        raise UsageError(
            f"setting '{label}' ran {batch} episodes at a time, without times: run it with rollout.batch=1"
        )
    episodes = data.episodes.loc[data.episodes["label"] == label, "episode"]
    whole = store.decodes(episodes.tolist(), _COLUMNS).combine_chunks()
    proposer = setting.settings.get("proposer", {})
    drafter = (int(proposer["depth"]), int(proposer["top_k"])) if "top_k" in proposer else None
    work, size = _work(whole, drafter)
    return LabelWork(work, whole["episode"].to_numpy(), size)


def _work(table: pa.Table, drafter: tuple[int, int] | None) -> tuple[Work, int]:
    """The work of a table of decodes, and N."""
    rounds = table["rounds"].combine_chunks()
    counts = pc.list_value_length(rounds).to_numpy(zero_copy_only=False).astype(np.int64)
    flat = rounds.flatten()
    columns = {name: flat.field(name).to_numpy(zero_copy_only=False) for name in (*_ROUND, "committed")}
    decode = np.repeat(np.arange(len(counts)), counts)
    size = int(np.bincount(decode, columns.pop("committed")).max())
    phases = {phase: np.nan_to_num(table[f"seconds.{phase}"].to_numpy()) for phase in READ_PHASES}
    looked_up = ~np.isnan(table["similarity"].to_numpy(zero_copy_only=False).astype(float))
    return work_of(columns, counts, phases, looked_up, size, drafter), size


def _check(named: NamedProfile, works: Mapping[str, LabelWork]) -> None:
    """Raises UsageError for a profile that cannot price the study."""
    target = named.profile.about.get("target", "TARGET")
    for label, label_work in works.items():
        if lacks := named.profile.lacks(label_work.work.needs):
            raise UsageError(
                f"on={named.name}: no cost of '{lacks[0]}', which setting '{label}' needs: measure it with "
                f"'kerv bench target={target}'"
            )
        if named.profile.tokens < label_work.size:
            raise UsageError(
                f"on={named.name}: its costs are of chunks of {named.profile.tokens} tokens, setting '{label}' "
                f"decodes {label_work.size}: measure them with 'kerv bench target={target} tokens=[{label_work.size}]'"
            )


def _priced(episodes: pd.DataFrame, label_work: LabelWork, profile: Profile) -> pd.DataFrame:
    """The episodes, with the seconds that their decodes would take there."""
    seconds = prices(label_work.work, profile)
    whole = np.bincount(label_work.episode, seconds, len(episodes))
    order = np.argsort(label_work.episode, kind="stable")
    stops = np.cumsum(np.bincount(label_work.episode, minlength=len(episodes)))[:-1]
    return episodes.assign(seconds=whole, decode_seconds=pd.Series(np.split(seconds[order], stops), episodes.index))


def repriced_summary(table: pd.DataFrame) -> pd.DataFrame:
    """As text: a row per setting, per episode before per control step; as measured, then a column pair per machine."""
    rows: dict[str, dict[str, str]] = {}
    for row in rows_of(table):
        cells = rows.setdefault(row["label"], {"setting": row["label"]})
        for head, prefix in ((f"measured, {row['measured_on']}", "measured_"), (row["machine"], "")):
            for name, unit in SPEEDS.items():
                cells[f"{head}: {unit}"] = compared(intervals(f"{prefix}{name}"), "1")(row)
    return pd.DataFrame(rows.values())
