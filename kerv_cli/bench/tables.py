"""Rows of the tables that `kerv bench` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from kerv_cli.bench.ceilings import MethodCeiling
from kerv_cli.bench.phases import Phase

PHASE_COLUMNS = ("phase", "median ms", "p95", "least", "GB/s", "GFLOP/s", "floor ms", "least ÷ floor")


def card_rows(card: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return (name, value) rows about sizes of the model, limits of the device, and least times of forwards.

    Args:
        card: Result of `run.card_of`.
    """
    rows = [
        ("weights that a forward reads", f"{card['weights'] / 1e6:.1f} M, {card['weight_bytes'] / 1e6:.1f} MB"),
        ("cache of prompt and chunk", f"{card['cache_bytes'] / 1e6:.2f} MB"),
        ("memory, measured", f"{card['bandwidth'] / 1e9:.1f} GB/s"),
        ("memory that holds the weights, measured", f"{card['bandwidth_of_weights'] / 1e9:.1f} GB/s"),
        ("arithmetic, measured", f"{card['flops'] / 1e9:.0f} GFLOP/s"),
    ]
    for name, (reading, computing) in card["floors"].items():
        why = "to read the weights" if reading >= computing else "for the arithmetic"
        rows.append((f"floor of {name}", f"{1e3 * max(reading, computing):.2f} ms, {why}"))
    return rows


def phase_rows(phases: Sequence[Phase]) -> list[tuple[str, ...]]:
    """Return a row per phase with the columns PHASE_COLUMNS. A floor is the least time that the device allows."""
    rows: list[tuple[str, ...]] = []
    for phase in phases:
        limits = ("–", "–", "–", "–")
        if phase.floor > 0:
            rates = (f"{phase.read / phase.seconds / 1e9:.1f}", f"{phase.flops / phase.seconds / 1e9:.0f}")
            limits = (*rates, f"{1e3 * phase.floor:.3f}", f"{phase.least / phase.floor:.1f}")
        times = (f"{1e3 * phase.seconds:.2f}", f"{1e3 * phase.p95:.2f}", f"{1e3 * phase.least:.2f}")
        rows.append((phase.name, *times, *limits))
    return rows


def ceiling_rows(by_tokens: Mapping[int, Sequence[MethodCeiling]]) -> list[tuple[str, ...]]:
    """Return a row per method: its name, then for each N the remaining forwards and the two speedups.

    Args:
        by_tokens: N (tokens of a chunk) -> highest speedup of each method.
    """
    by_method: dict[str, list[str]] = {}
    for ceilings in by_tokens.values():
        for one in ceilings:
            by_method.setdefault(one.method, []).extend([one.how, f"{one.free:.2f}", f"{one.drafted:.2f}"])
    return [(method, *row) for method, row in by_method.items()]
