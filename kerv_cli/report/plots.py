"""Figures of a study from its tables: measures along an axis, under stress and at latencies; success
against speed; success task by task."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kerv_cli.report.drawing import (
    INK,
    MUTED,
    STYLE,
    entitle,
    new_figure,
    place_labels,
    setting_colours,
    shared_legend,
)
from kerv_cli.report.measures import MICRO, Row
from kerv_cli.report.stressed import by_kind, is_stressed
from kerv_cli.report.tables import is_baseline, is_number, rows_of

_DASHES: Any = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (7, 2, 1.5, 2)), (0, (3, 1, 1, 1, 1, 1)))
_DODGE = 0.012  # of an axis, between the points of two methods
_NARROWEST = 0.05  # of an axis, between two ticks
_ACROSS = 4  # panels beside one another
_MOST_SETTINGS = 20  # columns of a map that can still be read
_UNKNOWN = "#f4f6f8"  # the baseline itself, and fields without a pair
_FAR = 50.0  # points of difference at which a map's colours end


@dataclass(frozen=True)
class Measure:
    """A column of a study's table on a figure's axis. level: the baseline's value where it is none of its own
    column's."""

    column: str
    title: str
    unit: str
    scale: float = 1.0
    level: float | None = None

    def of(self, row: Row, end: str = "") -> float:
        """A row's value in the axis's unit, or that of its interval's end, `_low` or `_high`; NaN where it has none."""
        value = row.get(f"{self.column}{end}")
        return math.nan if value is None else self.scale * float(value)


SUCCESS = Measure("success", "Success", "success, % of episodes and 95 % interval", 100.0)
SPEED = Measure("episode_speedup", "Speed per episode", "time per episode, baseline ÷ setting", level=1.0)
MEASURES = (
    SPEED,
    Measure("speedup", "Speed per control step", "time per step, baseline ÷ setting", level=1.0),
    SUCCESS,
    Measure("AL", "Acceptance length", "tokens committed per verification", level=1.0),  # AR: a token per forward
)


def study_figures(table: pd.DataFrame, axis: str, title: str) -> dict[str, Figure]:
    """Name suffix -> figure: measures against the axis; without an
    axis success against speed, where it was measured. A study of stress has one figure, of success.

    Args:
        table: a study's; its rows pooled over tasks are drawn.
        axis: column for the x axis, e.g. `threshold.r`; empty, or without a setting at two of its numbers: none.
        title: the study's.
    """
    rows = table[table["averaging"] == MICRO].reset_index(drop=True)
    heading = title, about(rows)
    if is_stressed(rows):
        return {"": lines_figure(by_kind(table), "stress_level", "level", *heading)}
    numbers = any(len(group) > 1 for group in series_of(rows, axis).values())
    if numbers:
        return {"": _against_axis(rows, axis, *heading)}
    return {"_tradeoff": _tradeoff(rows_of(rows), *heading)} if rows["episode_speedup"].notna().any() else {}


def about(rows: pd.DataFrame, what: str = MICRO) -> str:
    """A figure's subtitle: targets, counts, what is drawn, device."""
    first = rows.iloc[0]
    counts = f"{rows['tasks'].max()} tasks, {rows['episodes'].max()} episodes per setting"
    targets = dict.fromkeys(str(name) for name in rows["target"])
    names = ", ".join(targets) if len(targets) <= 2 else f"{len(targets)} targets"  # more are wider than a figure
    return f"{names} · {counts} · {what} · {first['device_name']}, {first['dtype']}"


def draw(
    panel: Axes,
    at: Sequence[float],
    rows: Sequence[Row],
    measure: Measure,
    shade: str,
    along_x: bool = False,
    **style: object,
) -> None:
    """Draws the rows' values at these positions, joined by the style's line, and bars for their 95 % intervals. A value
    that does not exist is left out. along_x: the measure is on the x axis."""
    points = [(x, row) for x, row in zip(at, rows, strict=True) if is_number(row[measure.column])]
    for x, row in points:
        ends = [measure.of(row, "_low"), measure.of(row, "_high")]
        bar = (ends, [x, x]) if along_x else ([x, x], ends)
        panel.plot(*bar, color=shade, linewidth=2.0, alpha=0.4)
    if points:
        positions, values = [x for x, _ in points], [measure.of(row) for _, row in points]
        line: Any = {"color": shade, "marker": "o", "markersize": 5, "linewidth": 1.8} | style
        panel.plot(*((values, positions) if along_x else (positions, values)), **line)


def series_of(rows: pd.DataFrame, axis: str) -> dict[str, pd.DataFrame]:
    """Rows by everything that varies besides the axis: legend text -> rows along the axis, with its number as `x`.

    A row without a number on the axis is a series of its own. The baseline is only included where it is a point of
    another series.
    """
    reference = rows["label"] == rows["baseline"]
    methods = rows[~reference]
    varying = _varying(methods, axis)
    numbers = axis_numbers(methods, axis)
    series: dict[str, pd.DataFrame] = {}
    keys = [methods[name].map(str) for name in varying] + [methods["label"].where(numbers.isna(), "")]
    groups = [group for _, group in methods.groupby(keys, sort=False)]
    shared = Counter(name for group in groups if len(group) > 1 for name in set(group["name"]))
    for group in groups:
        first = group.iloc[0]
        name = str(first["label"])
        if len(group) > 1:
            same = group["name"].nunique() == 1
            name = str(first["name"] if same else first["method"])
            if not same or shared[name] > 1:
                values = [f"{key.split('.')[-1]} {first[key]}" for key in varying if "sha256" not in key]
                name = ", ".join([name, *values])
            point = reference & (rows["name"] == first["name"])
            for key in varying:
                point &= rows[key].map(str) == str(first[key])
            group = pd.concat([group, rows[point]])
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


def _against_axis(rows: pd.DataFrame, axis: str, title: str, about: str) -> Figure:
    """A panel per measure: a line per series, and to the right of the last tick the settings without a number."""
    series = series_of(rows, axis)
    ticks = sorted({float(x) for group in series.values() if len(group) > 1 for x in group["x"]})
    gap = (ticks[-1] - ticks[0]) / max(2, min(11, len(ticks) - 1))
    apart = [name for name, group in series.items() if len(group) == 1]
    beside = {name: ticks[-1] + gap * (0.8 + 0.55 * number) for number, name in enumerate(apart)}
    shades = setting_colours([next(row for row in rows_of(group) if not is_baseline(row)) for group in series.values()])
    numbers = ticks[:: math.ceil(len(ticks) / 9)]
    with mpl.rc_context(STYLE):
        figure = new_figure(15.0, 4.8 + min(1.6, 0.075 * max(map(len, apart), default=0)))
        panels = figure.subplots(1, len(MEASURES))
        for panel, measure in zip(panels, MEASURES, strict=True):
            for shade, (name, group) in zip(shades, series.items(), strict=True):
                if name in beside:
                    draw(panel, [beside[name]], rows_of(group), measure, shade, marker="D")
                else:
                    draw(panel, list(group["x"]), rows_of(group), measure, shade, label=name)
            panel.set(title=measure.title, ylabel=measure.unit, xlabel=axis)
            panel.set_xticks([*numbers, *beside.values()], [*(f"{value:g}" for value in numbers), *beside])
            for label in panel.get_xticklabels()[len(numbers) :]:
                label.set(rotation=90, fontsize=8, color=INK)
            _mark_baseline(panel, rows, measure)
            panel.margins(y=0.12)
            if measure is SUCCESS:
                _limit_success(panel, rows_of(rows))
        shared_legend(figure, panels)
        entitle(figure, title, about)
    return figure


def _mark_baseline(panel: Axes, rows: pd.DataFrame, measure: Measure) -> None:
    """A dotted line at the baseline's value."""
    for row in filter(is_baseline, rows_of(rows)):
        level = measure.of(row) if measure.level is None else measure.level
        panel.axhline(level, color=INK, linewidth=1.2, linestyle=":", label=str(row["label"]))


def _limit_success(panel: Axes, rows: Iterable[Row]) -> None:
    """Limits the axis of success: from a little below the lowest interval, so that differences show, to a little above
    100 %, without a tick there."""
    lows = [low for row in rows if is_number(low := SUCCESS.of(row, "_low"))]
    floor = max(0.0, 5.0 * math.floor((min(lows, default=0.0) - 3.0) / 5.0))
    panel.set_ylim(floor, 103)
    panel.set_yticks([tick for tick in panel.get_yticks() if floor <= tick <= 100])


def _tradeoff(rows: Sequence[Row], title: str, about: str) -> Figure:
    """Speed per episode on x, success on y, every setting a labelled point. A setting without a speed, such as the
    scripted expert, is a dashed level of success."""
    # the baseline's speed is 1 by definition
    points = [row | {"episode_speedup": 1.0} if is_baseline(row) else row for row in rows]
    points = [row for row in points if is_number(row["episode_speedup"])]
    shades = setting_colours(points)
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 6.4)
        panel = figure.subplots()
        for row, shade in zip(points, shades, strict=True):
            draw(panel, [SPEED.of(row)], [row], SUCCESS, shade, markersize=7)
            draw(panel, [SUCCESS.of(row)], [row], SPEED, shade, along_x=True, marker="")
        for row in rows:
            if not any(row["label"] == point["label"] for point in points):
                panel.axhline(SUCCESS.of(row), color=MUTED, linewidth=1.1, linestyle=_DASHES[1])
                corner: Any = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
                panel.annotate(str(row["label"]), (1.0, SUCCESS.of(row)), (-4, 3), ha="right", color=MUTED, **corner)
        panel.axvline(1.0, color=INK, linewidth=1.2, linestyle=":")
        panel.set(title="Success against speed per episode", xlabel=f"speed: {SPEED.unit}", ylabel=SUCCESS.unit)
        panel.margins(x=0.14)
        panel.set_xlim(left=max(0.0, panel.get_xlim()[0]))
        _limit_success(panel, rows)
        entitle(figure, title, about)  # before the labels: it moves the panel
        labels = [(SPEED.of(row), SUCCESS.of(row), str(row["label"])) for row in points]
        place_labels(figure, panel, labels, shades)
    return figure


def lines_figure(
    panels: Mapping[str, Mapping[str, Sequence[Row]]], x: str, xlabel: str, title: str, about: str, log: bool = False
) -> Figure:
    """Success over a number, a line per method.

    Args:
        panels: title of a panel -> method -> its rows along x.
        x: column of the number. log: its axis is logarithmic.
        xlabel: its name.
    """
    first: dict[str, Row] = {}
    for name, rows in ((name, rows) for lines in panels.values() for name, rows in lines.items()):
        first.setdefault(name, rows[0])
    shades = setting_colours(first.values())
    across = min(_ACROSS, len(panels))
    down = -(-len(panels) // across)
    every = [row for lines in panels.values() for rows in lines.values() for row in rows if is_number(row[x])]
    position = math.log if log else float
    ticks = sorted({float(row[x]) for row in every})
    span = position(ticks[-1]) - position(ticks[0])
    for value in ticks[::-1][:-1]:  # none beside another whose label it would touch
        below = ticks[ticks.index(value) - 1]
        if position(value) - position(below) < _NARROWEST * span:
            ticks.remove(value)
    with mpl.rc_context(STYLE):
        figure = new_figure(max(10.0, 3.3 * across), 2.0 + (3.6 if down == 1 else 2.7 * down))
        axes = figure.subplots(down, across, squeeze=False, sharey=True).ravel()
        for panel, (head, lines) in zip(axes, panels.items(), strict=False):
            for number, (name, shade) in enumerate(zip(first, shades, strict=True)):
                aside = _DODGE * span * (number - (len(first) - 1) / 2)
                rows = [row for row in lines.get(name, ()) if is_number(row[x])]
                at = [float(row[x]) * math.exp(aside) if log else float(row[x]) + aside for row in rows]
                draw(panel, at, rows, SUCCESS, shade, label=name, linestyle=_DASHES[number % len(_DASHES)])
            panel.set(title=head, xlabel=xlabel, **({"xscale": "log"} if log else {}))
            panel.set_xticks([], minor=True)
            panel.set_xticks(ticks, [f"{value:.3g}" for value in ticks])
            _limit_success(panel, every)
        for panel in axes[len(panels) :]:
            panel.set_visible(False)
        axes[0].set_ylabel(SUCCESS.unit)
        entitle(figure, title, about)
        shared_legend(figure, axes)
    return figure


def latency_figure(table: pd.DataFrame, title: str, about: str) -> Figure:
    """Success over the time that AR's decode takes, a panel per compensation of the delay. table: `latency_table`'s."""
    panels: dict[str, dict[str, list[Row]]] = {}
    for row in rows_of(table[table["ar_latency_ms"] > 0].sort_values("ar_latency_ms", kind="stable")):
        lines = panels.setdefault(f"delay compensation: {row['rollout.delay_compensation']}", {})
        lines.setdefault(row["method"], []).append({**row, "baseline": row["ar"]})
    return lines_figure(panels, "ar_latency_ms", "an autoregressive decode takes, ms", title, about, log=True)


def has_task_map(per_task: pd.DataFrame) -> bool:
    """Whether a study's table by task makes a map: two tasks or more, and few settings, under one stress."""
    several = per_task["task"].nunique() > 1 and 1 < per_task["label"].nunique() <= _MOST_SETTINGS
    return several and not is_stressed(per_task)


def task_map(per_task: pd.DataFrame, title: str, about: str) -> Figure:
    """Tasks down, settings across: successes of episodes in each field, coloured by the difference to the baseline in
    points over the same worlds. per_task: a study's table by task."""
    tasks, labels = (list(dict.fromkeys(per_task[name])) for name in ("task", "label"))
    points = 100.0 * per_task.pivot(index="task", columns="label", values="difference").loc[tasks, labels].to_numpy(
        float
    )
    with mpl.rc_context(STYLE):
        figure = new_figure(3.4 + 0.95 * len(labels), 2.2 + 0.27 * len(tasks))
        panel = figure.subplots()
        colours = mpl.colormaps["RdBu"].with_extremes(bad=_UNKNOWN)
        image = panel.imshow(points, cmap=colours, vmin=-_FAR, vmax=_FAR, aspect="auto")
        for row in rows_of(per_task):
            y, x = tasks.index(row["task"]), labels.index(row["label"])
            shade = "white" if abs(points[y, x]) > 0.7 * _FAR else INK
            text = f"{int(row['successes'])}/{int(row['episodes'])}"
            panel.text(x, y, text, ha="center", va="center", fontsize=8, color=shade)
        panel.set_yticks(range(len(tasks)), tasks, color=INK)
        panel.set_xticks(range(len(labels)), labels, rotation=35, ha="right", color=INK)
        panel.tick_params(length=0)
        panel.grid(visible=False)
        panel.spines[:].set_visible(False)
        bar = figure.colorbar(image, ax=panel, shrink=0.8, pad=0.02, label="points, against the baseline")
        bar.outline.set_visible(False)
        entitle(figure, title, about)
    return figure
