"""Figures of a study from its table: measures along an axis or by setting, and time by phase."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kerv_cli.engine.record import PHASES
from kerv_cli.report.drawing import COLOURS, INK, MUTED, STYLE, entitle, new_figure, setting_colours, shared_legend
from kerv_cli.report.measures import MICRO
from kerv_cli.report.scatter import limit_success, tradeoff_figure
from kerv_cli.report.stressed import is_stressed, stress_figure
from kerv_cli.report.summary import SPEEDS
from kerv_cli.report.tables import is_number, rows_of

_PHASE_COLOURS = ("#7fb2d9", "#0b6fb8", "#e9b44c", "#d1495b", "#e8a0a8", "#2a9d6f", "#dfe5eb")
_PANELS = (
    ("episode_speedup", "Speed per episode", "time per episode, baseline ÷ setting", 1.0),
    ("speedup", "Speed per control step", "time per step, baseline ÷ setting", 1.0),
    ("success", "Success", "episodes, % and 95 % interval", 100.0),
    ("AL", "Acceptance length", "tokens committed per verification", 1.0),
)


_CONTINUES = "… "
"""In front of a label that adds something to the one above it."""


def study_figures(table: pd.DataFrame, axis: str, title: str, averaging: str = MICRO) -> dict[str, Figure]:
    """Name suffix -> figure: measures against the axis, and inference time by phase where it was measured; without an
    axis the measures by setting, and success against speedup. A study of stress has one figure, `stress_figure`.

    Args:
        table: `study_table`.
        axis: column for the x axis, e.g. `threshold.r`; empty, or without a setting at two of its numbers: one row per
            setting.
        title: the study's.
        averaging: the rows that are drawn; named in the figure.
    """
    rows = table[table["averaging"] == averaging].reset_index(drop=True)
    if is_stressed(rows):
        return {"": stress_figure(rows, title, about(rows, averaging), averaging)}
    numbers = any(len(group) > 1 for group in series_of(rows, axis).values())
    with mpl.rc_context(STYLE):
        figures = {"": _against_axis(rows, axis)} if numbers else {"": _by_setting(rows)}
        if rows["time_per_step_ms"].notna().any():
            figures["_phases"] = _phases(rows)
        for figure in figures.values():
            entitle(figure, title, about(rows, averaging))
        if not numbers:
            figures["_tradeoff"] = tradeoff_figure(rows, title, about(rows, averaging))
    return figures


def about(rows: pd.DataFrame, averaging: str) -> str:
    """A figure's subtitle: targets, counts, averaging, device."""
    first = rows.iloc[0]
    counts = f"{rows['tasks'].max()} tasks, {rows['episodes'].max()} episodes per setting"
    targets = dict.fromkeys(str(name) for name in rows["target"])
    names = ", ".join(targets) if len(targets) <= 2 else f"{len(targets)} targets"  # more are wider than a figure
    return f"{names} · {counts} · {averaging} · {first['device_name']}, {first['dtype']}"


def _is_baseline(rows: pd.DataFrame) -> pd.Series:
    return rows["label"] == rows["baseline"]


def series_of(rows: pd.DataFrame, axis: str) -> dict[str, pd.DataFrame]:
    """Rows by everything that varies besides the axis: legend text -> rows along the axis, with its number as `x`.

    A row without a number on the axis is a series of its own. The baseline is only included where it is a point of
    another series.
    """
    methods = rows[~_is_baseline(rows)]
    varying = _varying(methods, axis)
    numbers = axis_numbers(methods, axis)
    series: dict[str, pd.DataFrame] = {}
    keys = [methods[name].map(str) for name in varying] + [methods["label"].where(numbers.isna(), "")]
    for _, group in methods.groupby(keys, sort=False):
        stems = {_stem(str(label), axis) for label in group["label"]}
        name = str(group["label"].iloc[0]) if len(group) == 1 else stems.pop()
        if len(group) > 1 and (stems or name in series):
            shared = [f"{key.split('.')[-1]} {group[key].iloc[0]}" for key in varying if "sha256" not in key]
            name = ", ".join([str(group["method"].iloc[0]), *shared])
        if len(group) > 1:
            group = pd.concat([group, rows[_is_baseline(rows) & (rows["label"].map(lambda x: _stem(x, axis)) == name)]])
        series[name] = group.assign(x=axis_numbers(group, axis)).sort_values("x")
    return series


def _varying(rows: pd.DataFrame, axis: str) -> list[str]:
    first, last = list(rows.columns).index("overrides") + 1, list(rows.columns).index("horizon")
    candidates = ["method", *rows.columns[first:last]]
    return [name for name in candidates if name != axis and rows[name].map(str).nunique() > 1]


def axis_numbers(rows: pd.DataFrame, axis: str) -> pd.Series:
    """The axis's values; NaN for text, booleans and missing values."""
    values = rows[axis] if axis in rows else pd.Series(math.nan, index=rows.index)
    values = values.map(lambda value: math.nan if isinstance(value, bool | np.bool_) else value)
    return pd.to_numeric(values, errors="coerce")


def _stem(label: str, axis: str) -> str:
    """A grid's label without the axis: `fused f_star=0.3` -> `fused`."""
    return re.sub(rf"\s+{re.escape(axis.rsplit('.', 1)[-1])}=\S+", "", label)


def _against_axis(rows: pd.DataFrame, axis: str) -> Figure:
    series = series_of(rows, axis)
    names = [*(name for name, group in series.items() if len(group) > 1), str(rows["baseline"].iloc[0])]
    columns = max(1, min(6, int(15.0 / (0.7 + 0.08 * max(map(len, names))))))
    longest = max((len(name) for name, group in series.items() if len(group) == 1), default=0)
    figure = new_figure(15.0, 4.4 + 0.21 * math.ceil(len(names) / columns) + min(1.6, 0.075 * longest))
    axes = figure.subplots(1, len(_PANELS))
    ticks = sorted({float(x) for group in series.values() if len(group) > 1 for x in group["x"]})
    beside = _positions_beside(ticks, [label for label, group in series.items() if len(group) == 1])
    others = [group[~_is_baseline(group)].iloc[0] for group in series.values()]
    shades = setting_colours(rows_of(pd.DataFrame(others)))
    for panel, (measure, name, unit, scale) in zip(axes, _PANELS, strict=True):
        for number, (label, group) in enumerate(series.items()):
            if len(group) > 1:
                _draw_series(panel, group, measure, scale, shades[number], label)
            else:
                _draw_beside(panel, beside[label], rows_of(group)[0], measure, scale, shades[number])
        _draw_baseline(panel, rows, measure, scale)
        panel.set(title=name, ylabel=unit, xlabel=axis)
        _name_ticks(panel, ticks, beside)
        if measure == "success":
            limit_success(panel, rows)
        else:
            panel.margins(y=0.12)
    shared_legend(figure, axes, columns)
    return figure


def _positions_beside(ticks: Sequence[float], names: Sequence[str]) -> dict[str, float]:
    """Setting without a number on the axis -> its x: to the right of the last tick, one after the other."""
    span = (ticks[-1] - ticks[0]) or 1.0
    gap = max(span / max(2, len(ticks) - 1), 0.09 * span)
    return {name: ticks[-1] + gap * (0.8 + 0.55 * number) for number, name in enumerate(names)}


def _name_ticks(panel: Axes, ticks: Sequence[float], beside: Mapping[str, float]) -> None:
    """Ticks of the numbers, and upright names of the settings beside them, behind a thin line."""
    numbers = list(ticks) if len(ticks) <= 9 else list(ticks[:: math.ceil(len(ticks) / 9)])
    panel.set_xticks([*numbers, *beside.values()], [*(f"{value:g}" for value in numbers), *beside])
    for label in panel.get_xticklabels()[len(numbers) :]:
        label.set(rotation=90, fontsize=8, color=INK)
    if beside:
        panel.axvline((ticks[-1] + min(beside.values())) / 2, color=MUTED, linewidth=0.8, alpha=0.5)


def _draw_series(panel: Axes, group: pd.DataFrame, measure: str, scale: float, shade: str, label: str) -> None:
    x, y = group["x"].to_numpy(float), group[measure].to_numpy(float) * scale
    panel.plot(x, y, color=shade, marker="o", markersize=5, linewidth=1.8, label=label)
    if f"{measure}_low" in group:
        low, high = group[f"{measure}_low"].to_numpy(float) * scale, group[f"{measure}_high"].to_numpy(float) * scale
        panel.fill_between(x, low, high, color=shade, alpha=0.15, linewidth=0)


def _draw_beside(panel: Axes, x: float, row: dict[str, Any], measure: str, scale: float, shade: str) -> None:
    if not is_number(row[measure]):
        return
    low, high = row.get(f"{measure}_low", math.nan), row.get(f"{measure}_high", math.nan)
    if is_number(low):
        panel.plot([x, x], [low * scale, high * scale], color=shade, linewidth=2.2, alpha=0.45)
    panel.plot(x, row[measure] * scale, "D", color=shade, markersize=6)


def _draw_baseline(panel: Axes, rows: pd.DataFrame, measure: str, scale: float) -> None:
    reference = rows[_is_baseline(rows)]
    if not len(reference):
        return
    row = reference.iloc[0]
    value = 1.0 / scale if measure in (*SPEEDS, "AL") else row[measure]  # AR commits one token per forward
    panel.axhline(value * scale, color=INK, linewidth=1.2, linestyle=":", label=str(row["label"]))
    if measure == "success":
        panel.axhspan(row["success_low"] * scale, row["success_high"] * scale, color=INK, alpha=0.06, linewidth=0)


def _by_setting(rows: pd.DataFrame) -> Figure:
    figure = new_figure(15.0, 2.0 + 0.38 * len(rows))
    axes = figure.subplots(1, len(_PANELS), sharey=True)
    for panel, (measure, name, unit, scale) in zip(axes, _PANELS, strict=True):
        for number, row in enumerate(rows_of(rows)):
            _draw_dot(panel, number, row, measure, scale)
        reference = rows[_is_baseline(rows)]
        if len(reference) and measure != "AL":
            level = 1.0 if measure in SPEEDS else reference.iloc[0][measure] * scale
            panel.axvline(level, color=INK, linewidth=1.2, linestyle=":")
        panel.set(title=name, xlabel=unit)
        panel.grid(axis="y", visible=False)
        if measure == "speedup":
            _draw_ceilings(panel, rows)
        if measure == "success":
            limit_success(panel, rows, "x")
        else:
            panel.set_xlim(0, 1.08 * panel.get_xlim()[1])
        _separate(panel, rows)
    _name_rows(axes[0], _grouped_names(rows))
    return figure


def _grouped_names(rows: pd.DataFrame) -> pd.Series:
    """Labels; one that continues the label above, as `kerv, fixed r = 9` does `kerv`, shows what it adds, indented."""
    names: list[str] = []
    stem = ""
    for label in map(str, rows["label"]):
        if stem and label.startswith(f"{stem}, "):
            names.append(f"{_CONTINUES}{label.removeprefix(stem + ', ')}")
        else:
            stem = label
            names.append(label)
    return pd.Series(names)


def _separate(panel: Axes, rows: pd.DataFrame) -> None:
    """A thin line above every setting that begins a group, where some setting continues another."""
    names = list(_grouped_names(rows))
    starts = [y for y, name in enumerate(names) if not name.startswith(_CONTINUES)]
    for y in starts[1:] if len(starts) < len(names) else ():
        panel.axhline(y - 0.5, color=MUTED, linewidth=0.7, alpha=0.5)


def _name_rows(panel: Axes, names: pd.Series) -> None:
    """Names along y, the first on top."""
    panel.set_yticks(range(len(names)), list(names), color=INK)
    panel.set_ylim(len(names) - 0.5, -0.5)
    panel.grid(axis="y", visible=False)


def _draw_ceilings(panel: Axes, rows: pd.DataFrame) -> None:
    ceilings = rows["ceiling"].dropna()
    if len(ceilings):
        panel.plot(ceilings, ceilings.index, "|", color=MUTED, markersize=13, markeredgewidth=1.6)
        panel.set_xlabel(f"{panel.get_xlabel()}; | ceiling")


def _draw_dot(panel: Axes, y: int, row: dict[str, Any], measure: str, scale: float) -> None:
    if not is_number(row[measure]):
        return
    colour = INK if row["label"] == row["baseline"] else COLOURS[0]
    value = row[measure] * scale
    low, high = row.get(f"{measure}_low", math.nan), row.get(f"{measure}_high", math.nan)
    if is_number(low):
        panel.plot([low * scale, high * scale], [y, y], color=colour, linewidth=2.2, alpha=0.45)
    panel.plot(value, y, "o", color=colour, markersize=7)
    text = f"{value:.1f}".removesuffix(".0") if measure == "success" else f"{value:.2f}"
    panel.annotate(
        text,
        (value, y),
        xytext=(0, 8),
        textcoords="offset points",
        ha="center",
        fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.4},
    )


def _phases(rows: pd.DataFrame) -> Figure:
    figure = new_figure(10.0, 2.0 + 0.36 * len(rows))
    panel = figure.subplots()
    y, left = np.arange(len(rows)), np.zeros(len(rows))
    for phase, shade in zip(PHASES, _PHASE_COLOURS, strict=True):
        widths = rows[f"ms.{phase}"].fillna(0.0).to_numpy()
        if widths.any():
            panel.barh(y, widths, 0.66, left, color=shade, label=phase, edgecolor="white", linewidth=0.6)
        left = left + widths
    for number, total in enumerate(rows["time_per_step_ms"]):
        text = f"  {total:.3g}" if is_number(total) else "  not timed"
        panel.text(total if is_number(total) else 0.0, number, text, va="center", fontsize=9)
    _name_rows(panel, rows["label"])
    panel.set(title="Inference time by phase", xlabel="ms per control step")
    panel.margins(x=0.08)
    figure.legend(loc="outside lower center", ncols=len(PHASES))
    return figure
