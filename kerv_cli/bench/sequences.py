"""Recorded decodes of a study as sequences of forwards: the kind of each, and its number of tokens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from kerv_cli.base.errors import UsageError
from kerv_cli.engine.cost import DECODE_TIMES, DecodeSequence, sequence_of
from kerv_cli.lab.identity import batch_of
from kerv_cli.lab.plan import Cell
from kerv_cli.lab.store import StudyStore

_COLUMNS = ["task", "seed", "index", "rounds", *DECODE_TIMES]


@dataclass(frozen=True)
class Recorded:
    """The sampled decodes of one setting. proposer: its settings, as stored. successes, episodes: of all its cells."""

    label: str
    sequences: tuple[DecodeSequence, ...]
    proposer: Mapping[str, Any]
    successes: int
    episodes: int


def read_study(store: StudyStore, tokens: int, decodes: int) -> list[Recorded]:
    """The settings of a study, `decodes` decodes of each, evenly over tasks and seeds; the baseline first.

    Raises:
        UsageError: no such study, no complete cell, chunks shorter than `tokens`, or decodes without times.
        CheckpointError: a damaged plan or cell.
    """
    plan = store.read_plan()
    complete, _ = store.read_cells(plan.cells)
    by_label: dict[str, list[Cell]] = {}
    for cell in plan.cells:
        if cell.id in complete and cell.repeat == 0:
            by_label.setdefault(cell.label, []).append(cell)
    if plan.baseline not in by_label:
        raise UsageError(f"study '{store.name}' has no complete cell of its baseline '{plan.baseline}'")
    labels = sorted(by_label, key=lambda label: label != plan.baseline)
    return [_setting(label, by_label[label], complete, tokens, decodes) for label in labels]


def _setting(label: str, cells: Sequence[Cell], complete: Mapping[str, Any], tokens: int, decodes: int) -> Recorded:
    stored = [complete[cell.id] for cell in cells]
    if (batch := batch_of(cells[0].settings)) > 1:
        raise UsageError(
            f"setting '{label}' ran {batch} episodes at a time, without times: run it with rollout.batch=1"
        )
    frames = [pq.read_table(cell.folder / "decodes.parquet", columns=_COLUMNS).to_pandas() for cell in stored]
    rows = pd.concat(frames).sort_values(["task", "seed", "index"])
    rows[list(DECODE_TIMES)] = rows[list(DECODE_TIMES)].fillna(0.0)  # phases that a decode has not
    size = max(sum(int(r["committed"]) for r in rounds) for rounds in rows["rounds"])
    if size < tokens:
        raise UsageError(f"setting '{label}' decodes chunks of {size} tokens: tokens={tokens} cannot be cut from them")
    indices = np.unique(np.linspace(0, len(rows) - 1, min(decodes, len(rows))).astype(int))
    samples = rows.iloc[indices].to_dict("records")
    episodes = sum(len(cell.episodes) for cell in stored)
    successes = sum(int(cell.episodes["success"].sum()) for cell in stored)
    sequences = tuple(sequence_of(row, size, tokens) for row in samples)
    return Recorded(label, sequences, cells[0].settings["proposer"], successes, episodes)
