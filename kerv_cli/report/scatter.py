"""Figure of success against speed per episode: every setting is a labelled point."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

from kerv_cli.report.drawing import INK, MUTED, entitle, new_figure, setting_colours
from kerv_cli.report.tables import is_number, rows_of

_DISTANCES = (9.0, 14.0, 21.0, 30.0, 40.0, 52.0, 66.0, 82.0, 100.0)  # points from the marker, tried in turn
_ANGLES = tuple(math.radians(a) for a in (45, -45, 135, -135, 90, -90, 20, -20, 160, -160, 65, -65, 115, -115))
_MARKER = 5.0  # points, half the width that a marker keeps free
_CLEAR = 2.0  # points around a label
_POINT = 72.0  # per inch


def tradeoff_figure(rows: pd.DataFrame, title: str, about: str) -> Figure:
    """Speed per episode on x, success on y, bars for the 95 % intervals. A setting without a speed, such as the
    scripted expert, is a dashed level of success."""
    figure = new_figure(11.0, 6.4)
    panel = figure.subplots()
    drawn = rows_of(rows)
    points = [row for row in drawn if is_number(row["episode_speedup"])]
    shades = setting_colours(points)
    for row, shade in zip(points, shades, strict=True):
        _draw_point(panel, row, shade)
    for row in drawn:
        if not is_number(row["episode_speedup"]):
            _draw_level(panel, row)
    panel.axvline(1.0, color=INK, linewidth=1.2, linestyle=":")
    panel.set(xlabel="speed: time per episode, baseline ÷ setting", ylabel="success, % of episodes")
    panel.margins(x=0.14)
    panel.set_xlim(left=max(0.0, panel.get_xlim()[0]))
    limit_success(panel, rows)
    panel.set_title("Success against speed per episode")
    entitle(figure, title, about)  # before the labels: it moves the panel
    labels = [(row["episode_speedup"], 100 * row["success"], str(row["label"])) for row in points]
    place_labels(figure, panel, labels, shades)
    return figure


def success_floor(rows: pd.DataFrame) -> float:
    """Where an axis of success begins, in percent: a little below the lowest interval, so that differences show."""
    lows = [100 * value for value in rows["success_low"] if is_number(value)]
    return max(0.0, 5.0 * math.floor((min(lows, default=0.0) - 3.0) / 5.0))


def limit_success(panel: Axes, rows: pd.DataFrame, axis: str = "y") -> None:
    """Limits an axis of success: from `success_floor` to a little above 100 %, without a tick there."""
    floor = success_floor(rows)
    panel.set(**{f"{axis}lim": (floor, 103)})
    panel.set(**{f"{axis}ticks": [tick for tick in getattr(panel, f"get_{axis}ticks")() if floor <= tick <= 100]})


def _draw_point(panel: Axes, row: dict[str, Any], shade: str) -> None:
    x, y = row["episode_speedup"], 100 * row["success"]
    bars: Any = {"color": shade, "linewidth": 1.6, "alpha": 0.4}
    panel.plot([x, x], [100 * row["success_low"], 100 * row["success_high"]], **bars)
    if is_number(row["episode_speedup_low"]):
        panel.plot([row["episode_speedup_low"], row["episode_speedup_high"]], [y, y], **bars)
    panel.plot(x, y, "o", color=shade, markersize=7)


def _draw_level(panel: Axes, row: dict[str, Any]) -> None:
    y = 100 * row["success"]
    panel.axhline(y, color=MUTED, linewidth=1.1, linestyle=(0, (4, 2)))
    panel.annotate(
        str(row["label"]),
        (1.0, y),
        (-4, 3),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        ha="right",
        fontsize=9,
        color=MUTED,
    )


def place_labels(
    figure: Figure, panel: Axes, labels: Sequence[tuple[float, float, str]], shades: Sequence[str]
) -> list[Annotation]:
    """Writes every label near its point (x, y in data units), clear of other labels, markers and the frame.

    Greedy, the most crowded point first: candidate places around the point are tried from near to far; the first that
    covers nothing is taken, else the one that covers least. A thin line joins a distant label to its point.
    """
    renderer = _renderer(figure)
    scale = figure.dpi / _POINT  # pixels per point
    spots = [panel.transData.transform((x, y)) for x, y, _ in labels]
    obstacles = [Bbox.from_extents(x - _MARKER, y - _MARKER, x + _MARKER, y + _MARKER).padded(scale) for x, y in spots]
    obstacles += [text.get_window_extent(renderer) for text in panel.texts]
    frame = panel.get_window_extent(renderer)
    notes: list[Annotation] = []
    for number in _crowded_first(spots):
        x, y, text = labels[number]
        note = panel.annotate(
            text,
            (x, y),
            (0, 0),
            textcoords="offset points",
            fontsize=9,
            color=shades[number],
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
            arrowprops={"arrowstyle": "-", "color": shades[number], "linewidth": 0.7, "shrinkA": 0, "shrinkB": 3},
        )
        note.set_in_layout(False)
        size = Annotation.get_window_extent(note, renderer).padded(_CLEAR * scale)
        offset = _best_offset(spots[number], size.width, size.height, scale, obstacles, frame)
        note.set_position((offset[0] / scale, offset[1] / scale))
        obstacles.append(_box(spots[number] + offset, size.width, size.height))
        notes.append(note)
    return notes


def _renderer(figure: Figure) -> RendererAgg:
    """The renderer, after the layout has placed every panel."""
    figure.draw_without_rendering()
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    return canvas.get_renderer()


def _crowded_first(spots: Sequence[np.ndarray]) -> list[int]:
    if len(spots) < 2:
        return list(range(len(spots)))
    points = np.array(spots)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    near = np.sort(apart, axis=1)[:, 1 : 1 + min(3, len(spots) - 1)].mean(1)
    return [int(i) for i in np.argsort(near, kind="stable")]


def _best_offset(
    spot: np.ndarray, width: float, height: float, scale: float, obstacles: Sequence[Bbox], frame: Bbox
) -> np.ndarray:
    """Pixels from the point to the label's centre."""
    best, least = np.zeros(2), math.inf
    for offset in _offsets(width, height, scale):
        box = _box(spot + offset, width, height)
        cost = sum(_shared(box, other) for other in obstacles) + 4 * (width * height - _shared(box, frame))
        if cost < least - 1e-9:
            best, least = offset, cost
        if cost <= 0:
            break
    return best


def _offsets(width: float, height: float, scale: float) -> Iterator[np.ndarray]:
    """The label's nearest edge or corner lies at the distance, in the angle's direction."""
    for distance in _DISTANCES:
        for angle in _ANGLES:
            across, up = math.cos(angle), math.sin(angle)
            away = np.array([across, up]) * distance * scale
            yield away + np.array([round(across, 1) * width / 2, round(up, 1) * height / 2])


def _box(centre: np.ndarray, width: float, height: float) -> Bbox:
    return Bbox.from_bounds(centre[0] - width / 2, centre[1] - height / 2, width, height)


def _shared(a: Bbox, b: Bbox) -> float:
    """Area that two boxes share, pixels²."""
    both = Bbox.intersection(a, b)
    return float(both.width * both.height) if both is not None else 0.0
