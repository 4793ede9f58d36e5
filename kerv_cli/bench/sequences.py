"""Recorded decodes as sequences of forwards: which ran, and over how many tokens, as a study's cells say."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from kerv_cli.decoding.record import PARALLEL
from kerv_cli.errors import UsageError
from kerv_cli.studies.plan import Cell
from kerv_cli.studies.store import StudyStore

DRAFTER = "drafter"
_HOST = ("seconds.accept", "seconds.rectify", "seconds.other")
_TIMES = ("seconds.propose", *_HOST)
_COLUMNS = ["task", "seed", "index", "rounds", *_TIMES]


@dataclass(frozen=True)
class Forward:
    """One forward of the target. kind: prefill | verify. start: tokens committed before it. drafted: nodes it verifies.
    accepted: draft tokens committed. proposer: who drafted, empty without a draft."""

    kind: str
    start: int
    drafted: int
    accepted: int
    proposer: str = ""


@dataclass(frozen=True)
class DecodeSequence:
    """One decode. forwards: empty where the draft was executed unverified. host: seconds, as recorded, of all that does
    not depend on the target's size: acceptance, rectification, and proposers other than the drafter."""

    forwards: tuple[Forward, ...]
    host: float

    @property
    def drafts(self) -> bool:
        """Whether the drafter, whose shape follows the target's, drafted in it."""
        return any(f.proposer == DRAFTER for f in self.forwards)


@dataclass(frozen=True)
class Recorded:
    """The sampled decodes of one setting. proposer: its settings, as stored. successes, episodes: of all its cells."""

    label: str
    sequences: tuple[DecodeSequence, ...]
    proposer: Mapping[str, Any]
    successes: int
    episodes: int


def sequence_of(row: Mapping[str, Any], size: int, tokens: int) -> DecodeSequence:
    """A row of decodes.parquet, cut to its first `tokens` of `size` tokens. A draft that reached beyond the cut shrinks
    with the depth that is left; a round behind the cut is left out."""
    forwards = []
    for played in row["rounds"]:
        start, nodes = int(played["start"]), int(played["tree_size"])
        if played["mode"] == "skip" or start >= tokens:
            continue
        if played["mode"] == PARALLEL:
            forwards.append(Forward("prefill", 0, tokens, 0))
            continue
        left, most = tokens - start - 1, size - start - 1  # tokens that a draft may have here, and had in the record
        if left < 1:
            nodes = 0
        elif nodes >= most:
            nodes = math.ceil(nodes * left / most)
        kind = "prefill" if start == 0 else "verify"
        accepted = min(int(played["accepted"]), left) if nodes else 0
        forwards.append(Forward(kind, start, nodes, accepted, str(played["proposer"]) if nodes else ""))
    drafted = any(f.proposer == DRAFTER for f in forwards)
    host = sum(float(row[name]) for name in (_HOST if drafted else _TIMES))
    return DecodeSequence(tuple(forwards), host)


def read_study(store: StudyStore, tokens: int, decodes: int) -> list[Recorded]:
    """The settings of a study, `decodes` decodes of each, evenly over tasks and seeds; the baseline first.

    Raises:
        UsageError: no such study, no complete cell, or chunks shorter than `tokens`.
        CheckpointError: a damaged plan or cell.
    """
    plan = store.read_plan()
    found, _ = store.read_cells(plan.cells)
    by_label: dict[str, list[Cell]] = {}
    for cell in plan.cells:
        if cell.id in found and cell.repeat == 0:
            by_label.setdefault(cell.label, []).append(cell)
    if plan.baseline not in by_label:
        raise UsageError(f"study '{store.name}' has no complete cell of its baseline '{plan.baseline}'")
    labels = sorted(by_label, key=lambda label: label != plan.baseline)
    return [_setting(label, by_label[label], found, tokens, decodes) for label in labels]


def _setting(label: str, cells: Sequence[Cell], found: Mapping[str, Any], tokens: int, decodes: int) -> Recorded:
    stored = [found[cell.id] for cell in cells]
    frames = [pq.read_table(cell.folder / "decodes.parquet", columns=_COLUMNS).to_pandas() for cell in stored]
    rows = pd.concat(frames).sort_values(["task", "seed", "index"])
    rows[list(_TIMES)] = rows[list(_TIMES)].fillna(0.0)  # phases that a decode has not
    size = max(sum(int(r["committed"]) for r in rounds) for rounds in rows["rounds"])
    if size < tokens:
        raise UsageError(f"setting '{label}' decodes chunks of {size} tokens: tokens={tokens} cannot be cut from them")
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(decodes, len(rows))).astype(int))
    picked = rows.iloc[chosen].to_dict("records")
    episodes = sum(len(cell.episodes) for cell in stored)
    successes = sum(int(cell.episodes["success"].sum()) for cell in stored)
    sequences = tuple(sequence_of(row, size, tokens) for row in picked)
    return Recorded(label, sequences, cells[0].settings["proposer"], successes, episodes)
