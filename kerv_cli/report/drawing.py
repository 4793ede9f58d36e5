"""Style, colours and files of all figures: no display, the same bytes for the same numbers."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox
from PIL import Image

from kerv_cli.base.files import write_bytes
from kerv_cli.base.registry import parts
from kerv_cli.report.measures import Row

INK, MUTED, GRID = "#1f2933", "#6b7785", "#e3e8ee"
COLOURS = ("#0b6fb8", "#d1495b", "#2a9d6f", "#8d5fd3", "#e08e1b", "#3aa6b9", "#7a5c3e")  # distinct when colour-blind
STYLE: Any = {
    "figure.constrained_layout.use": True,
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
_ANGLES = (45, -45, 135, -135, 90, -90, 20, -20, 160, -160, 65, -65, 115, -115)  # of a label from its point, degrees
_DISTANCES = (9.0, 14.0, 21.0, 30.0, 40.0, 52.0, 66.0, 82.0, 100.0)  # of its nearest edge or corner, points
_MARKER, _CLEAR = 5.0, 2.0  # points around a marker and around a label


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that many inches; call inside `mpl.rc_context(STYLE)`."""
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def entitle(figure: Figure, title: str, about: str) -> None:
    """Writes the title and a small subtitle above the panels."""
    height, inch = figure.get_figheight(), 1.0 / figure.get_figheight()
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - 0.72 / height), w_pad=0.12, h_pad=0.06)
    figure.text(0.012, 1.0 - 0.24 * inch, title, fontsize=13, fontweight="bold", va="center")
    figure.text(0.012, 1.0 - 0.54 * inch, about, fontsize=9, color=MUTED, va="center")


def shared_legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """One legend below the panels, each label once, in as many columns as the figure is wide for."""
    entries = [pair for panel in panels for pair in zip(*panel.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in entries}
    columns = int(figure.get_figwidth() / (0.7 + 0.08 * max(map(len, handles))))
    columns = max(1, min(6, columns, len(handles)))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)


def place_labels(
    figure: Figure, panel: Axes, labels: Sequence[tuple[float, float, str]], shades: Sequence[str]
) -> list[Annotation]:
    """Writes every label near its point (x, y in data units), clear of other labels, markers and the frame; a thin line
    joins a distant one to its point.

    Greedy, the most crowded point first: of the places around the point, from near to far, the one that covers least.
    """
    figure.draw_without_rendering()  # places the panels
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    pixels = figure.dpi / 72.0
    spots = panel.transData.transform([(x, y) for x, y, _ in labels]) if labels else np.empty((0, 2))
    covered = [_box(spot, 2 * _MARKER * pixels, 2 * _MARKER * pixels) for spot in spots]
    covered += [text.get_window_extent(renderer) for text in panel.texts]
    frame = panel.get_window_extent(renderer)
    notes = []
    apart = np.sort(np.linalg.norm(spots[:, None] - spots[None], axis=-1), axis=1)[:, :4].sum(1)
    for number in np.argsort(apart, kind="stable"):
        x, y, text = labels[number]
        shade, centred = shades[number], dict[str, Any](ha="center", va="center")
        line = {"arrowstyle": "-", "color": shade, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 3}
        note = panel.annotate(
            *(text, (x, y), (0, 0)), textcoords="offset points", fontsize=9, color=shade, arrowprops=line, **centred
        )
        note.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
        note.set_in_layout(False)
        size = Annotation.get_window_extent(note, renderer).padded(_CLEAR * pixels)
        boxes = [
            _box(spots[number] + offset, size.width, size.height)
            for offset in _offsets(size.width, size.height, pixels)
        ]
        box = min(boxes, key=lambda box: sum(_area(box, other) for other in covered) - 4 * _area(box, frame))
        note.set_position(tuple((box.get_points().mean(0) - spots[number]) / pixels))
        covered.append(box)
        notes.append(note)
    return notes


def _offsets(width: float, height: float, pixels: float) -> Iterator[np.ndarray]:
    """Vectors from a point to the centre of a label beside it, pixels, from near to far."""
    for distance in _DISTANCES:
        for angle in np.radians(_ANGLES):
            way = np.array([math.cos(angle), math.sin(angle)])
            yield way * distance * pixels + way.round(1) * [width / 2, height / 2]


def _box(centre: np.ndarray, width: float, height: float) -> Bbox:
    return Bbox.from_bounds(centre[0] - width / 2, centre[1] - height / 2, width, height)


def _area(a: Bbox, b: Bbox) -> float:
    """Area that two boxes share, whole pixels²."""
    both = Bbox.intersection(a, b)
    return 0.0 if both is None else round(both.width * both.height)


_COLOUR_COLUMNS = {"policy.kind": "policy", "prefill_draft.kind": "proposer", "proposer.kind": "proposer"}
"""Columns whose parts give a setting its colour -> the kind of those parts."""


def setting_colours(rows: Iterable[Row]) -> list[str]:
    """A colour per setting, from its row of a study's table: ink for the baseline; for another the first free colour of
    its parts, else of the palette."""
    colours: list[str] = []
    for row in rows:
        if row["label"] == row["baseline"]:
            colours.append(INK)
            continue
        names = {column: str(row.get(column)) for column in _COLOUR_COLUMNS}
        entries = [parts(_COLOUR_COLUMNS[column]).get(name) for column, name in names.items() if name != "none"]
        preferred = [f"#{part.colour:06x}" for part in entries if part is not None and part.colour is not None]
        free = [shade for shade in (*preferred, *COLOURS) if shade not in colours]
        colours.append(free[0] if free else COLOURS[len(colours) % len(COLOURS)])
    return colours


def save_plot(figure: Figure, path: Path) -> str:
    """Writes a PNG file atomically and without a date -> an HTML element that holds the figure itself.

    Raises:
        StorageError: the disk refused.
    """
    content = figure_bytes(figure)
    write_bytes(path, content)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(content).decode()}">'


def figure_bytes(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG file with a palette: half the size, and no other picture."""
    buffer, small = io.BytesIO(), io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    Image.open(buffer).convert("RGB").quantize(256).save(small, "PNG", optimize=True)
    return small.getvalue()
