"""What every figure shares: one style, no display, the same bytes for the same numbers."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from kerv_cli.files import atomic_path

INK, MUTED, GRID = "#1f2933", "#6b7785", "#e3e8ee"
COLOURS = ("#0b6fb8", "#d1495b", "#2a9d6f", "#8d5fd3", "#e08e1b", "#3aa6b9", "#7a5c3e")  # told apart when colour-blind
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
    "svg.hashsalt": "kerv",  # ids in the file do not change from run to run
    "svg.fonttype": "path",
}
DASHES: Any = ((0, (5, 2)), (0, (1.5, 1.5)), (0, (7, 2, 1.5, 2)), (0, (3, 1, 1, 1, 1, 1)))


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that many inches; call inside `mpl.rc_context(STYLE)`."""
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def entitle(figure: Figure, title: str, about: str) -> None:
    """Title and, in small print, what the figure is about, in a band of their own above the panels."""
    height, inch = figure.get_figheight(), 1.0 / figure.get_figheight()
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - 0.72 / height), w_pad=0.12, h_pad=0.06)
    figure.text(0.012, 1.0 - 0.24 * inch, title, fontsize=13, fontweight="bold", va="center")
    figure.text(0.012, 1.0 - 0.54 * inch, about, fontsize=9, color=MUTED, va="center")


def colour(place: int) -> str:
    """The colour of the n-th series; they come round again, so a series that may be many has dashes as well."""
    return COLOURS[place % len(COLOURS)]


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
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=150, metadata=metadata)
    return buffer.getvalue()
