"""Rows of the tables that `kerv bench` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kerv_cli.bench.ceilings import MethodCeiling
from kerv_cli.bench.phases import Phase


def card_rows(card: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return the target's sizes, the device's rates and the lower bounds on time that follow from them."""
    return [
        ("weights that a forward reads", f"{card['weights'] / 1e6:.1f} M, {card['weight_bytes'] / 1e6:.1f} MB"),
        ("cache of prompt and chunk", f"{card['cache_bytes'] / 1e6:.2f} MB"),
        ("bandwidth, measured", f"{card['bandwidth'] / 1e9:.1f} GB/s"),
        ("products, measured", f"{card['flops'] / 1e9:.0f} GFLOP/s"),
        ("floor of one token", f"{1e3 * card['floor_token']:.2f} ms"),
        ("floor of a verification of N", f"{1e3 * card['floor_verify']:.2f} ms"),
        ("floor of the prefill", f"{1e3 * card['floor_prefill']:.2f} ms"),
        ("floor of prefill and N", f"{1e3 * card['floor_both']:.2f} ms"),
    ]


def phase_rows(phases: Sequence[Phase]) -> list[tuple[str, ...]]:
    """Return a row per phase: times in milliseconds, rates, share of the device's rate."""
    rows: list[tuple[str, ...]] = []
    for phase in phases:
        limited = phase.floor > 0
        rates = (f"{phase.read / phase.seconds / 1e9:.1f}", f"{phase.flops / phase.seconds / 1e9:.0f}")
        times = (f"{1e3 * phase.seconds:.2f}", f"{1e3 * phase.p95:.2f}", f"{1e3 * phase.least:.2f}")
        floor = (f"{1e3 * phase.floor:.2f}", f"{100 * phase.share:.0f}") if limited else ("–", "–")
        rows.append((phase.name, *times, *(rates if limited else ("–", "–")), *floor))
    return rows


PHASE_COLUMNS = ("phase", "median ms", "p95", "least", "GB/s", "GFLOP/s", "floor ms", "share %")


def ceiling_rows(by_tokens: Mapping[int, Sequence[MethodCeiling]]) -> list[tuple[str, ...]]:
    """Return a row per method with three columns per N."""
    by_method: dict[str, list[str]] = {}
    for ceilings in by_tokens.values():
        for ceiling in ceilings:
            row = by_method.setdefault(ceiling.method, [])
            row += [ceiling.how, f"{ceiling.free:.2f}", f"{ceiling.drafted:.2f}"]
    return [(method, *row) for method, row in by_method.items()]
