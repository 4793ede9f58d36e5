"""Figures of a study from its tables, as PNG: no display, the same bytes for the same numbers."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kerv_cli.report.measures import MICRO, Row
from kerv_cli.report.stressed import by_kind, is_stressed
from kerv_cli.report.tables import is_baseline, is_number, rows_of

INK, MUTED, GRID = "#1f2933", "#6b7785", "#e3e8ee"
COLOURS = ("#0b6fb8", "#d1495b", "#2a9d6f", "#8d5fd3", "#e08e1b", "#3aa6b9", "#7a5c3e")  # distinct when colour-blind
MARKERS = "os^Dv"
STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "axes.axisbelow": True,
    "legend.frameon": False,
}
_ACROSS = 4  # panels beside one another


@dataclass(frozen=True)
class Measure:
    """A column of a study's table on a figure's axis."""

    column: str
    title: str
    unit: str
    scale: float = 1.0

    def of(self, row: Row, end: str = "") -> float:
        """Return a row's value, or the `_low` or `_high` end of its interval, in the axis's unit; NaN if missing."""
        if self is SPEED and is_baseline(row):
            return 1.0  # by definition
        value = row[f"{self.column}{end}"]
        return self.scale * float(value) if is_number(value) else math.nan

    def bars(self, rows: Sequence[Row]) -> list[list[float]]:
        """Return the distances from the rows' values to both ends of their intervals."""
        return [[abs(self.of(row, end) - self.of(row)) for row in rows] for end in ("_low", "_high")]


SUCCESS = Measure("success", "Success", "success, % of episodes and 95 % interval", 100.0)
SPEED = Measure("episode_speedup", "Speed per episode", "speed: time per episode, baseline ÷ setting")


@dataclass(frozen=True)
class Panel:
    """Lines of a measure over a number.

    Attributes:
        title: Its heading.
        x: Column of the number.
        xlabel: Name of the number.
        measure: The measure.
        lines: Name of a line -> its rows. A line of one row is drawn as a level.
    """

    title: str
    x: str
    xlabel: str
    measure: Measure
    lines: Mapping[str, Sequence[Row]]


def study_figures(table: pd.DataFrame, axis: str, title: str) -> dict[str, Figure]:
    """Return name suffix -> figure; rows pooled over tasks are drawn.

    A study of stress is drawn as success over the level. A study with settings at several numbers of its axis is drawn
    as speed and success along the axis, any other as success against speed if it was timed.

    Args:
        table: A study's table.
        axis: Column of the x axis, such as `threshold.r`; may be empty.
        title: The study's title.
    """
    rows = table[table["averaging"] == MICRO]
    heading = f"{title}\n{about(rows)}"
    if is_stressed(rows):
        panels = [Panel(kind, "stress_level", "level", SUCCESS, lines) for kind, lines in by_kind(table).items()]
        return {"": lines_figure(panels, heading)}
    lines = series_of(rows, axis)
    if any(len(line) > 1 for line in lines.values()):
        return {"": lines_figure([Panel(m.title, axis, axis, m, lines) for m in (SPEED, SUCCESS)], heading)}
    return {"_tradeoff": _tradeoff(rows_of(rows), heading)} if rows["episode_speedup"].notna().any() else {}


def about(rows: pd.DataFrame) -> str:
    """Return a figure's subtitle: targets, counts, device."""
    first, targets = rows.iloc[0], list(dict.fromkeys(str(name) for name in rows["policy.target"]))
    names = ", ".join(targets) if len(targets) <= 2 else f"{len(targets)} targets"
    counts = f"{rows['tasks'].max()} tasks, {rows['episodes'].max()} episodes per setting"
    return f"{names} · {counts} · {first['device_name']}, {first['runtime.dtype']}"


def series_of(rows: pd.DataFrame, axis: str) -> dict[str, list[Row]]:
    """Return settings that differ only along the axis, in its order: name of the series -> rows.

    A row without a number on the axis is a series of its own.
    """
    series: dict[str, list[Row]] = {}
    for row in rows_of(rows):
        series.setdefault(str(row["series"] if is_number(row.get(axis)) else row["label"]), []).append(row)
    lines = {}
    for name, line in series.items():
        if len(line) == 1:
            name = str(line[0]["label"])
        lines[name] = sorted(line, key=lambda row: float(row[axis])) if len(line) > 1 else line
    return lines


def lines_figure(panels: Sequence[Panel], heading: str) -> Figure:
    """Draw panels side by side with one legend; a name has the same colour in all of them."""
    names = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    across = min(_ACROSS, len(panels))
    down = -(-len(panels) // across)
    with mpl.rc_context(STYLE):
        figure = new_figure(max(10.0, 3.4 * across), 1.6 + 3.2 * down, heading)
        axes = figure.subplots(down, across, squeeze=False).ravel()
        for drawn, panel in zip(axes, panels, strict=False):
            for name, rows in panel.lines.items():
                _draw(drawn, panel, name, rows, _look(names.index(name), all(map(is_baseline, rows))))
            drawn.set(title=panel.title, xlabel=panel.xlabel, ylabel=panel.measure.unit)
            if panel.measure is SUCCESS:
                _limit_success(drawn, [row for rows in panel.lines.values() for row in rows])
        for unused in axes[len(panels) :]:
            unused.set_visible(False)
        handles = {label: handle for panel in axes for handle, label in zip(*panel.get_legend_handles_labels())}  # noqa: B905
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(5, len(handles)))
    return figure


def _draw(axes: Axes, panel: Panel, name: str, rows: Sequence[Row], look: dict[str, Any]) -> None:
    measure = panel.measure
    if len(rows) == 1:
        axes.axhline(measure.of(rows[0]), label=name, linewidth=1.2, linestyle="--", color=look["color"])
        return
    rows = [row for row in rows if is_number(row[panel.x])]
    points = [float(row[panel.x]) for row in rows], [measure.of(row) for row in rows]
    axes.errorbar(*points, yerr=measure.bars(rows), label=name, elinewidth=1.0, markersize=5, **look)


def _look(number: int, baseline: bool) -> dict[str, Any]:
    colour = INK if baseline else COLOURS[number % len(COLOURS)]
    return {"color": colour, "marker": MARKERS[number // len(COLOURS) % len(MARKERS)]}


def _limit_success(axes: Axes, rows: Sequence[Row]) -> None:
    """Limit the axis of success from a little below the lowest interval to 100 %."""
    lowest = min((low for row in rows if not math.isnan(low := SUCCESS.of(row, "_low"))), default=0.0)
    axes.set_ylim(max(0.0, 5.0 * math.floor((lowest - 3.0) / 5.0)), 103)


def _tradeoff(rows: Sequence[Row], heading: str) -> Figure:
    """Draw success against speed per episode. A setting without a speed is a level of success."""
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 6.0, heading)
        axes = figure.subplots()
        for number, row in enumerate(rows):
            look, name = _look(number, is_baseline(row)), str(row["label"])
            x, y = SPEED.of(row), SUCCESS.of(row)
            if math.isnan(x):
                axes.axhline(y, label=name, linewidth=1.2, linestyle="--", color=look["color"])
            else:
                look |= {"xerr": SPEED.bars([row]), "yerr": SUCCESS.bars([row])}
                axes.errorbar([x], [y], label=name, elinewidth=1.0, markersize=7, linestyle="", **look)
        axes.axvline(1.0, color=INK, linewidth=1.2, linestyle=":")
        axes.set(title="Success against speed per episode", xlabel=SPEED.unit, ylabel=SUCCESS.unit)
        _limit_success(axes, rows)
        figure.legend(loc="outside right upper")
    return figure


def latency_figure(table: pd.DataFrame, heading: str) -> Figure:
    """Draw `latency_table`: success over the time that AR's decode takes, a panel per compensation of the delay."""
    panels: dict[str, dict[str, list[Row]]] = {}
    for row in rows_of(table[table["ar_latency_ms"] > 0].sort_values("ar_latency_ms", kind="stable")):
        lines = panels.setdefault(f"delay compensation: {row['rollout.delay_compensation']}", {})
        lines.setdefault(row["method"], []).append({**row, "baseline": row["ar"]})
    x = ("ar_latency_ms", "an autoregressive decode takes, ms")
    return lines_figure([Panel(title, *x, SUCCESS, lines) for title, lines in panels.items()], heading)


def new_figure(width: float, height: float, heading: str) -> Figure:
    """Return an empty figure of that many inches with a heading."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(heading, x=0.01, ha="left", fontsize=11)
    return figure


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file without a date."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()
