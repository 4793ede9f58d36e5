"""Figures of a study, from its table. Drawn without a display; the same table gives the same file."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from kerv_cli.decoding.record import PHASES
from kerv_cli.files import atomic_path
from kerv_cli.studies.measures import MICRO
from kerv_cli.studies.tables import is_number

_INK, _MUTED, _GRID = "#1f2933", "#6b7785", "#e3e8ee"
_COLOURS = ("#0b6fb8", "#d1495b", "#2a9d6f", "#8d5fd3", "#e08e1b", "#3aa6b9", "#7a5c3e")  # told apart when colour-blind
_PHASE_COLOURS = ("#b8c4d0", "#7fb2d9", "#0b6fb8", "#e9b44c", "#d1495b", "#e8a0a8", "#2a9d6f", "#dfe5eb")
_STYLE: Any = {
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": _MUTED,
    "axes.labelcolor": _INK,
    "text.color": _INK,
    "xtick.color": _MUTED,
    "ytick.color": _MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": _GRID,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "svg.hashsalt": "kerv",  # ids in the file do not change from run to run
    "svg.fonttype": "path",
}
_PANELS = (
    ("speedup", "Speedup", "time per step, baseline ÷ setting", 1.0),
    ("success", "Success", "episodes, % and 95 % interval", 100.0),
    ("AL", "Acceptance length", "tokens committed per verification", 1.0),
)


def study_figures(table: pd.DataFrame, axis: str, title: str, averaging: str = MICRO) -> dict[str, Figure]:
    """Name suffix -> figure: measures against the axis (or by setting), and inference time by phase.

    Args:
        table: `study_table`.
        axis: column for the x axis, e.g. `threshold.r`; empty, or without two numbers in it: one row per setting.
        title: the study's.
        averaging: the rows that are drawn; named in the figure.
    """
    rows = table[table["averaging"] == averaging].reset_index(drop=True)
    numbers = axis in rows and pd.to_numeric(rows.loc[~_is_baseline(rows), axis], errors="coerce").nunique() > 1
    with mpl.rc_context(_STYLE):
        measures = _against_axis(rows, axis) if numbers else _by_setting(rows)
        figures = {"": measures, "_phases": _phases(rows)}
        for figure in figures.values():
            _entitle(figure, title, rows, averaging)
    return figures


def save_figure(figure: Figure, path: Path) -> Path:
    """Writes a figure as the format of its suffix (.png, .svg), atomically and without a date.

    Raises:
        StorageError: the disk refused.
    """
    content = figure_bytes(figure, path.suffix[1:])
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return path


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as the bytes of a PNG or SVG file."""
    buffer = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with mpl.rc_context(_STYLE):
        figure.savefig(buffer, format=kind, dpi=150, metadata=metadata)
    return buffer.getvalue()


def _is_baseline(rows: pd.DataFrame) -> pd.Series:
    return rows["label"] == rows["baseline"]


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def _entitle(figure: Figure, title: str, rows: pd.DataFrame, averaging: str) -> None:
    """Title and what the figure averages over, in a band of their own above the panels."""
    height, inch = figure.get_figheight(), 1.0 / figure.get_figheight()
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - 0.72 / height), w_pad=0.12, h_pad=0.06)
    first = rows.iloc[0]
    counts = f"{rows['tasks'].max()} tasks, {rows['episodes'].max()} episodes per setting"
    where = f"{counts} · {averaging} · {first['device_name']}, {first['dtype']}"
    figure.text(0.012, 1.0 - 0.24 * inch, title, fontsize=13, fontweight="bold", va="center")
    figure.text(0.012, 1.0 - 0.54 * inch, where, fontsize=9, color=_MUTED, va="center")


def series_of(rows: pd.DataFrame, axis: str) -> dict[str, pd.DataFrame]:
    """Rows without the baseline, by everything that varies besides the axis: legend text -> rows along the axis."""
    own = rows[~_is_baseline(rows)]
    first, last = list(rows.columns).index("overrides") + 1, list(rows.columns).index("horizon")
    candidates = ["method", *rows.columns[first:last]]
    varying = [name for name in candidates if name != axis and own[name].astype(str).nunique() > 1]
    series: dict[str, pd.DataFrame] = {}
    groups = own.groupby([own[name].astype(str) for name in varying], sort=False) if varying else [((), own)]
    for _, group in groups:
        shared = [f"{name.split('.')[-1]} {group[name].iloc[0]}" for name in varying if "sha256" not in name]
        name = str(group["label"].iloc[0]) if len(group) == 1 else str(group["method"].iloc[0])
        if name in series:
            name = f"{name}, {', '.join(shared)}"
        series[name] = group.assign(x=pd.to_numeric(group[axis], errors="coerce")).sort_values("x")
    return series


def _against_axis(rows: pd.DataFrame, axis: str) -> Figure:
    figure = _figure(12.0, 4.6)
    axes = figure.subplots(1, len(_PANELS))
    series = series_of(rows, axis)
    for panel, (measure, name, unit, scale) in zip(axes, _PANELS, strict=True):
        for colour, (label, group) in zip(_cycle(len(series)), series.items(), strict=True):
            _draw_series(panel, group, measure, scale, colour, label)
        _draw_baseline(panel, rows, measure, scale)
        panel.set(title=name, ylabel=unit, xlabel=axis)
        _limit(panel, measure)
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)))
    return figure


def _cycle(count: int) -> list[str]:
    return [_COLOURS[i % len(_COLOURS)] for i in range(count)]


def _draw_series(panel: Axes, group: pd.DataFrame, measure: str, scale: float, colour: str, label: str) -> None:
    if len(group) == 1:  # a setting that the axis does not touch: a level to compare with
        level = group[measure].iloc[0] * scale
        if is_number(level):
            panel.axhline(level, color=colour, linestyle=(0, (4, 2)), linewidth=1.4, label=label)
        return
    x, y = group["x"].to_numpy(float), group[measure].to_numpy(float) * scale
    panel.plot(x, y, color=colour, marker="o", markersize=5, linewidth=1.8, label=label)
    if f"{measure}_low" in group:
        low, high = group[f"{measure}_low"].to_numpy(float) * scale, group[f"{measure}_high"].to_numpy(float) * scale
        panel.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
    if len(x) <= 9:
        panel.set_xticks(x, [f"{value:g}" for value in x])


def _draw_baseline(panel: Axes, rows: pd.DataFrame, measure: str, scale: float) -> None:
    own = rows[_is_baseline(rows)]
    if not len(own):
        return
    row = own.iloc[0]
    value = 1.0 / scale if measure in ("speedup", "AL") else row[measure]  # AR commits one token per forward
    panel.axhline(value * scale, color=_INK, linewidth=1.2, linestyle=":", label=str(row["label"]))
    if measure == "success":
        panel.axhspan(row["success_low"] * scale, row["success_high"] * scale, color=_INK, alpha=0.06, linewidth=0)


def _limit(panel: Axes, measure: str) -> None:
    """Success on its whole scale; ratios on theirs, which has no meaningful zero, with room above."""
    if measure == "success":
        panel.set_ylim(0, 104)
    else:
        panel.margins(y=0.12)


def _by_setting(rows: pd.DataFrame) -> Figure:
    figure = _figure(12.0, 2.0 + 0.38 * len(rows))
    axes = figure.subplots(1, len(_PANELS), sharey=True)
    places = range(len(rows))
    for panel, (measure, name, unit, scale) in zip(axes, _PANELS, strict=True):
        for place, row in zip(places, rows.to_dict("records"), strict=True):
            _draw_dot(panel, place, {str(k): v for k, v in row.items()}, measure, scale)
        reference = rows[_is_baseline(rows)]
        if len(reference) and measure != "AL":
            level = 1.0 if measure == "speedup" else reference.iloc[0][measure] * scale
            panel.axvline(level, color=_INK, linewidth=1.2, linestyle=":")
        panel.set(title=name, xlabel=unit)
        panel.grid(axis="y", visible=False)
        panel.set_xlim(0, 104 if measure == "success" else 1.08 * panel.get_xlim()[1])
    axes[0].set_yticks(list(places), list(rows["label"]), color=_INK)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    return figure


def _draw_dot(panel: Axes, place: int, row: dict[str, Any], measure: str, scale: float) -> None:
    if not is_number(row[measure]):
        return
    colour = _INK if row["label"] == row["baseline"] else _COLOURS[0]
    value = row[measure] * scale
    low, high = row.get(f"{measure}_low", math.nan), row.get(f"{measure}_high", math.nan)
    if is_number(low):
        panel.plot([low * scale, high * scale], [place, place], color=colour, linewidth=2.2, alpha=0.45)
    panel.plot(value, place, "o", color=colour, markersize=7)
    text = f"{value:.1f}".removesuffix(".0") if measure == "success" else f"{value:.2f}"
    panel.annotate(
        text,
        (value, place),
        xytext=(0, 8),
        textcoords="offset points",
        ha="center",
        fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.4},
    )


def _phases(rows: pd.DataFrame) -> Figure:
    figure = _figure(10.0, 2.0 + 0.36 * len(rows))
    panel = figure.subplots()
    places = list(range(len(rows)))
    left = [0.0] * len(rows)
    for phase, colour in zip(PHASES, _phase_colours(len(PHASES)), strict=True):
        widths = rows[f"ms.{phase}"].fillna(0.0).to_list()
        if any(widths):
            panel.barh(places, widths, 0.66, left, color=colour, label=phase, edgecolor="white", linewidth=0.6)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    for place, total in zip(places, rows["time_per_step_ms"], strict=True):
        panel.text(total, place, f"  {total:.3g}", va="center", fontsize=9)
    panel.set_yticks(places, list(rows["label"]), color=_INK)
    panel.set_ylim(len(rows) - 0.5, -0.5)
    panel.set(title="Inference time by phase", xlabel="ms per control step")
    panel.grid(axis="y", visible=False)
    panel.margins(x=0.08)
    figure.legend(loc="outside lower center", ncols=len(PHASES))
    return figure


def _phase_colours(count: int) -> Sequence[str]:
    return [_PHASE_COLOURS[i % len(_PHASE_COLOURS)] for i in range(count)]
