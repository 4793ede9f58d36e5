"""Read from a published table how a method drafted, and how many forwards its decodes took. This needs no torch."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kerv_cli.base.files import read_json
from kerv_cli.bench.expected import Drafts
from kerv_cli.targets.folders import shipped_dir

TABLES = {"papers": 4, "papers_libero": 7, "main": 16}
"""Published tables, each with N, the number of tokens per chunk of its decodes."""

_SOURCES = {"merged": "early", "early": "early", "scout": "scout", "scoped": "scout", "retrieval": "retrieval"}
_DRAFTERS = ("drafter", "hybrid")


@dataclass(frozen=True)
class Recorded:
    """How a setting of a published table decoded.

    Attributes:
        table: Name of the table.
        label: Label of the setting.
        method: Name of its method.
        tokens: N, number of tokens in a chunk.
        drafts: How it drafted.
        forwards: Forwards of the trunk per verified decode.
        speed: Measured speed against AR, per control step.
    """

    table: str
    label: str
    method: str
    tokens: int
    drafts: Drafts
    forwards: float
    speed: float


def nearest_table(tokens: int) -> str:
    """Return the table whose chunks are nearest in length to `tokens` tokens."""
    return min(TABLES, key=lambda name: abs(TABLES[name] - tokens))


def recorded(table: str) -> list[Recorded]:
    """Return the settings of a published table that decode token by token or with drafts, AR first.

    A wheel without the table gives none.

    Args:
        table: One of TABLES.
    """
    folder = shipped_dir().parent / "tables"
    if not (folder / f"{table}.json").is_file():
        return []
    settings = read_json(folder / f"{table}.json")["labels"]
    rows = [row for row in _rows(folder / f"{table}.csv") if row["averaging"].startswith("micro")]
    per_step = {row["label"]: float(row["forwards_per_step"]) for row in rows}
    found = []
    for row in rows:
        label, chosen = row["label"], settings[row["label"]]["settings"]
        if chosen["skip"]["kind"] == "parallel":
            continue
        drafts = _drafts(chosen, {name: float(row[name] or 0) for name in ("skip_rate", "retrieval_share")})
        verified = 1 - drafts.skipped
        forwards = TABLES[table] * per_step[label] / per_step[row["baseline"]] / verified if verified else 0.0
        found.append(Recorded(table, label, chosen["method"], TABLES[table], drafts, forwards, float(row["speedup"])))
    return found


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def _drafts(settings: Mapping[str, Any], shares: Mapping[str, float]) -> Drafts:
    """Return how a setting drafts.

    Args:
        settings: Its settings.
        shares: `skip_rate` and `retrieval_share`: shares of its decodes that ran unverified or retrieved a draft.
    """
    proposer, before, skipped = settings["proposer"], settings["prefill_draft"]["kind"], shares["skip_rate"]
    hybrid = proposer["kind"] == "hybrid"
    source = "retrieval" if hybrid else _SOURCES.get(before, "")
    searched = (shares["retrieval_share"] - skipped) / (1 - skipped) if hybrid and skipped < 1 else 0.0
    return Drafts(
        depth=proposer["depth"] if proposer["kind"] in _DRAFTERS else 0,
        nodes=proposer["nodes"] if proposer.get("shape") == "tree" else 0,
        source=source,
        in_prefill=bool(source) and not hybrid,
        retrieved=max(searched, 0.0),
        skipped=skipped,
        encodes=source != "scout",
    )
