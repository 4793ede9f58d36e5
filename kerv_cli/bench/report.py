"""Tables and the roofline plot of a bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.base.files import atomic_path
from kerv_cli.bench.ceilings import MethodCeiling
from kerv_cli.bench.machine import Machine
from kerv_cli.bench.phases import Phase


def card_rows(card: Mapping[str, float]) -> list[tuple[str, str]]:
    """Sizes of the target, rates of the device and the floors that follow, before the target is measured."""
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
    """One row per phase: times in milliseconds, rates, share of the roofline."""
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
    """One row per method, two columns per N."""
    by_method: dict[str, list[str]] = {}
    for ceilings in by_tokens.values():
        for ceiling in ceilings:
            row = by_method.setdefault(ceiling.method, [])
            row += [ceiling.how, f"{ceiling.free:.2f}", f"{ceiling.drafted:.2f}"]
    return [(method, *row) for method, row in by_method.items()]


def comparison_rows(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Phases that both documents have: medians in milliseconds and a over b."""
    other = {phase["name"]: phase for phase in b["phases"]}
    rows: list[tuple[str, ...]] = []
    for phase in a["phases"]:
        if phase["name"] in other:
            mine, theirs = phase["seconds"], other[phase["name"]]["seconds"]
            rows.append((phase["name"], f"{1e3 * mine:.2f}", f"{1e3 * theirs:.2f}", f"{mine / theirs:.2f}"))
    return rows


def plot_roofline(path: Path, title: str, machine: Machine, phases: Sequence[Phase]) -> None:
    """GFLOP/s over operations per byte, both logarithmic: the device's roof and every phase below it."""
    import matplotlib as mpl

    from kerv_cli.report.drawing import INK, STYLE, colour, entitle, new_figure
    from kerv_cli.report.scatter import place_labels

    limited = [phase for phase in phases if phase.floor > 0]
    with mpl.rc_context(STYLE):
        figure = new_figure(7.0, 4.6)
        axes = figure.subplots()
        intensity = [phase.flops / phase.read for phase in limited]
        knee = machine.flops / machine.bandwidth
        x = np.geomspace(min([*intensity, knee]) / 2, max([*intensity, knee]) * 2, 64)
        axes.plot(x, np.minimum(machine.flops, x * machine.bandwidth) / 1e9, color=INK)
        labels, shades = [], []
        for number, kind in enumerate(dict.fromkeys(phase.kind for phase in limited)):
            group = [phase for phase in limited if phase.kind == kind]
            at = [phase.flops / phase.read for phase in group], [phase.flops / phase.seconds / 1e9 for phase in group]
            axes.plot(*at, "o", color=colour(number), label=kind)
            labels += [(a, b, str(phase.rows)) for phase, a, b in zip(group, *at, strict=True)]
            shades += [colour(number)] * len(group)
        axes.set(xscale="log", yscale="log", xlabel="operations per byte", ylabel="GFLOP/s")
        axes.legend(title="phase, by rows")
        about = f"roof: {machine.bandwidth / 1e9:.1f} GB/s and {machine.flops / 1e9:.0f} GFLOP/s, measured"
        entitle(figure, title, about)
        place_labels(figure, axes, labels, shades)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", dpi=130)
