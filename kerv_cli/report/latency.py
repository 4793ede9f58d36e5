"""Success at a latency that the world feels (docs/methods.md §8): every setting beside AR at the same latency."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kerv_cli.base.settings import REAL, TimingSettings
from kerv_cli.report.ceiling import is_autoregressive
from kerv_cli.report.drawing import DASHES, INK, MUTED, STYLE, entitle, new_figure, setting_colours
from kerv_cli.report.measures import MICRO, measure
from kerv_cli.report.scatter import success_floor
from kerv_cli.report.summary import number
from kerv_cli.report.tables import StudyData, is_number, rows_of

_SUCCESS = ("successes", "success", "success_low", "success_high")
_FELT = ("felt_latency_ms", "felt_latency_steps", "held_share", "forwards_per_step")
_DIFFERENCE = ("pairs", "difference", "difference_low", "difference_high", "only_baseline", "only_method", "mcnemar_p")
_DODGE = 0.012  # of the axis, between neighbouring methods' bars
_NARROWEST = 0.12  # natural logarithm of two ticks' ratio, below which their labels touch


def latency_table(data: StudyData) -> pd.DataFrame | None:
    """One row per setting whose world goes on during a decode, pooled over tasks: its latency, its success, and the
    difference from AR with the same `rollout.*` in the same episodes. `ar_latency_ms`: mean latency of AR's decodes in
    those episodes. None where every world waits, or no setting is AR."""
    settings = {cell.label: cell.settings for cell in reversed(data.plan.cells)}
    episodes = {str(label): group for label, group in data.episodes.groupby("label", sort=False)}
    real = [label for label in data.plan.labels if label in episodes and _timing(settings[label])["clock"] == REAL]
    references = {_key(settings[label]): label for label in reversed(real) if is_autoregressive(settings[label])}
    rows = []
    for label in real:
        reference = references.get(_key(settings[label]))
        if reference is None:
            continue
        values = measure(episodes[label], episodes[reference], MICRO)
        ar = episodes[reference]
        head = {"study": data.plan.name, "label": label, "method": settings[label]["method"], "ar": reference}
        timing = {f"rollout.{name}": value for name, value in _timing(settings[label]).items()}
        latency = {"ar_latency_ms": 1000.0 * float(ar["delay_seconds"].sum() / ar["delay_decodes"].sum())}
        measures = {name: values[name] for name in (*_FELT, *_SUCCESS, *_DIFFERENCE)}
        parts = {f"{part}.kind": settings[label][part]["kind"] for part in ("prefill_draft", "proposer")}
        rows.append({**head, **timing, **latency, "episodes": len(episodes[label]), **measures, **parts})
    return pd.DataFrame(rows) if rows else None


def _timing(settings: Mapping[str, Any]) -> dict[str, Any]:
    """`rollout.*` of stored settings; the defaults where settings lack it, because they are older."""
    return {**dataclasses.asdict(TimingSettings()), **settings.get("rollout", {})}


def _key(settings: Mapping[str, Any]) -> str:
    return json.dumps(_timing(settings), sort_keys=True)


def latency_summary(table: pd.DataFrame) -> pd.DataFrame:
    """The main columns of `latency_table` as text."""
    return pd.DataFrame(
        {
            "setting": row["label"],
            "AR takes, ms": number(row["ar_latency_ms"]),
            "it takes, ms": number(row["felt_latency_ms"]),
            "steps": number(row["felt_latency_steps"]),
            "held": f"{100 * row['held_share']:.0f} %",
            "success %": _points(row, "success"),
            "minus AR's": "" if row["label"] == row["ar"] else _points(row, "difference"),
            "p": "" if row["label"] == row["ar"] or not row["pairs"] else f"{row['mcnemar_p']:.2g}",
        }
        for row in rows_of(table)
    )


def _points(row: Mapping[str, Any], name: str) -> str:
    if not is_number(row[name]):
        return "–"
    return f"{100 * row[name]:.1f} ({100 * row[f'{name}_low']:.0f} to {100 * row[f'{name}_high']:.0f})"


def latency_figure(table: pd.DataFrame, title: str, about: str) -> Figure:
    """Success over the time that AR's decode takes, a line per method with 95 % intervals; a panel per compensation of
    the delay. table: `latency_table`'s."""
    kinds = list(dict.fromkeys(table["rollout.delay_compensation"]))
    methods = list(dict.fromkeys(table["method"]))
    shades = dict(zip(methods, _shades(table, methods), strict=True))
    with mpl.rc_context(STYLE):
        width = max(6.5, 5.6 * len(kinds))
        figure = new_figure(width, 5.0)
        panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
        for panel, kind in zip(panels, kinds, strict=True):
            part = table[table["rollout.delay_compensation"] == kind]
            for number, method in enumerate(methods):
                rows = part[part["method"] == method].sort_values("ar_latency_ms")
                _draw(panel, rows, method, shades[method], number, len(methods))
            panel.set(title=f"delay compensation: {kind}", xlabel="an autoregressive decode takes, ms")
            panel.set_ylim(success_floor(table), 102)
            _name_latencies(panel, part)
        panels[0].set_ylabel("success, % of episodes and 95 % interval")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(6, len(labels), int(width / 2.0)))
        entitle(figure, title, about)
    return figure


def _shades(table: pd.DataFrame, methods: Sequence[str]) -> list[str]:
    """Ink for AR, for the others the colours of their parts."""
    first = [rows_of(table[table["method"] == method])[0] for method in methods]
    return setting_colours([{**row, "baseline": row["ar"]} for row in first])


def _draw(panel: Axes, rows: pd.DataFrame, method: str, shade: str, number: int, count: int) -> None:
    """One method: points joined by a line, and their intervals, a little apart from those of the others."""
    spread = 1.0 + 2.5 * _DODGE * (number - (count - 1) / 2)
    x = rows["ar_latency_ms"].to_numpy(float) * spread
    values = {name: 100.0 * rows[name].to_numpy(float) for name in ("success", "success_low", "success_high")}
    line = "-" if number == 0 else DASHES[(number - 1) % len(DASHES)]
    panel.plot(x, values["success"], color=shade, linestyle=line, marker="o", markersize=5, linewidth=1.7, label=method)
    panel.vlines(x, values["success_low"], values["success_high"], color=shade, linewidth=1.8, alpha=0.4)


def _name_latencies(panel: Axes, rows: pd.DataFrame) -> None:
    """Makes x logarithmic, with a tick at every latency whose label does not touch its neighbour's. A dotted line marks
    AR's latency without `rollout.ar_ms`, where other settings scale it."""
    scaled = rows["rollout.ar_ms"] > 0
    unscaled = rows[~scaled]["ar_latency_ms"]
    ticks: dict[float, str] = {}
    for x in [*sorted(rows[scaled]["ar_latency_ms"]), *sorted(unscaled)]:
        if is_number(x) and x > 0 and all(abs(math.log(x / other)) > _NARROWEST for other in ticks):
            ticks[float(f"{x:.3g}")] = f"{x:.3g}"
    panel.set_xscale("log")
    panel.set_xticks([], minor=True)
    panel.set_xticks(sorted(ticks), [ticks[x] for x in sorted(ticks)])
    if len(unscaled) and math.isfinite(unscaled.iloc[0]) and scaled.any():
        panel.axvline(unscaled.iloc[0], color=MUTED, linewidth=1.0, linestyle=":")
        panel.annotate(
            *(f"its own, {unscaled.iloc[0]:.3g}", (unscaled.iloc[0], 0.0), (3, 4)),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            fontsize=8,
            color=INK,
        )
