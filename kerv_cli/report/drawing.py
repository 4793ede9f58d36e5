"""Style, colours and files of all figures: no display, the same bytes for the same numbers."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

from kerv_cli.base.files import atomic_path
from kerv_cli.base.registry import parts

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
    """Writes the title and a small subtitle above the panels."""
    height, inch = figure.get_figheight(), 1.0 / figure.get_figheight()
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - 0.72 / height), w_pad=0.12, h_pad=0.06)
    figure.text(0.012, 1.0 - 0.24 * inch, title, fontsize=13, fontweight="bold", va="center")
    figure.text(0.012, 1.0 - 0.54 * inch, about, fontsize=9, color=MUTED, va="center")


def shared_legend(figure: Figure, panels: Iterable[Axes], columns: int) -> None:
    """One legend below the panels, each label once."""
    entries = [pair for panel in panels for pair in zip(*panel.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in entries}
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=max(1, min(columns, len(handles)))
    )


def colour(number: int) -> str:
    """Colour of the n-th series. The palette repeats after seven; use `DASHES` too where there can be more."""
    return COLOURS[number % len(COLOURS)]


_COLOUR_COLUMNS = {"policy.kind": "policy", "prefill_draft.kind": "proposer", "proposer.kind": "proposer"}
"""Columns whose parts give a setting its colour -> the kind of those parts."""


def setting_colours(rows: Iterable[Mapping[str, Any]]) -> list[str]:
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
        colours.append(free[0] if free else colour(len(colours)))
    return colours


SVG_LIMIT = 100_000  # bytes; figures of many points become larger and are stored as PNG only


@dataclass(frozen=True)
class Plot:
    """A figure's files, and an HTML element that holds the figure itself."""

    files: tuple[Path, ...]
    html: str


def save_plot(figure: Figure, folder: Path, name: str) -> Plot:
    """Writes `name`.png and, up to `SVG_LIMIT`, `name`.svg, atomically and without a date. An older `name`.svg is
    removed where the new one would be too large.

    Raises:
        StorageError: the disk refused.
    """
    contents = {kind: figure_bytes(figure, kind) for kind in ("png", "svg")}
    small = len(contents["svg"]) <= SVG_LIMIT
    if not small:
        del contents["svg"]
        (folder / f"{name}.svg").unlink(missing_ok=True)
    for kind, content in contents.items():
        with atomic_path(folder / f"{name}.{kind}") as temporary:
            temporary.write_bytes(content)
    files = tuple(folder / f"{name}.{kind}" for kind in contents)
    return Plot(files, _inline(contents["svg"].decode(), f"{name}-") if small else _embedded(contents["png"]))


def _inline(svg: str, prefix: str) -> str:
    """The <svg> element, its ids made unique: two figures of one page must not share clip paths."""
    text = svg[svg.index("<svg") :]
    for before in ('id="', 'xlink:href="#', "url(#"):
        text = text.replace(before, before + prefix)
    return text


def _embedded(png: bytes) -> str:
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as the bytes of an SVG file, or of a PNG file with a palette: half the size, and no other picture."""
    buffer, small = io.BytesIO(), io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=150, metadata=metadata)
    if kind == "svg":
        return buffer.getvalue()
    Image.open(buffer).convert("RGB").quantize(256).save(small, "PNG", optimize=True)
    return small.getvalue()
