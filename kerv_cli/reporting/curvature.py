"""Does a measure of curvature tell arcs from lines? Ours and HeiSD's public code's, on paths whose radius is known
(docs/methods.md §4.4): table and figure."""

from __future__ import annotations

import math

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from kerv_cli.decoding.boundary import path_length, radius_of_curvature
from kerv_cli.reporting.drawing import INK, MUTED, STYLE, entitle, new_figure

WINDOW = 15  # positions, the boundary's default
RADII = (0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3)  # metres; a line's is infinite
SPEEDS = (0.002, 0.004, 0.006, 0.008, 0.01)  # metres per control step; 0.01 is the hand at full speed
NOISE = 1e-4  # metres, on every measured coordinate
DRAWS = 6  # paths per radius and speed
_LINE = 0.75  # where lines stand on the axis of radii
_MEASURES = (
    ("radius_m", "Radius of curvature, ours", "fitted circle's radius, m"),
    ("pseudo_radius_m", "“Radius” of the public code", "a constant times the mean speed, m"),
)


def pseudo_radius(points: np.ndarray) -> float:
    """The "radius" of HeiSD's public code (docs/methods.md §4.4): a constant times the mean speed of points (n, 3),
    metres."""
    return 10.0 * path_length(points) / (len(points) - 1)


def known_paths(seed: int = 0) -> list[tuple[float, float, np.ndarray]]:
    """(radius in metres, speed in metres per step, points (WINDOW, 3)) of noisy arcs and lines, turned at random."""
    rng = np.random.default_rng(seed)
    return [
        (radius, speed, _path(radius, speed, rng))
        for radius in (*RADII, math.inf)
        for speed in SPEEDS
        for _ in range(DRAWS)
    ]


def _path(radius: float, speed: float, rng: np.random.Generator) -> np.ndarray:
    """(WINDOW, 3) points at equal distances `speed` along an arc or a line, turned at random, with noise."""
    way = speed * np.arange(WINDOW)
    flat = np.zeros((WINDOW, 3))
    if math.isinf(radius):
        flat[:, 0] = way
    else:
        flat[:, 0], flat[:, 1] = radius * np.sin(way / radius), radius * np.cos(way / radius)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return flat @ turn + rng.normal(size=flat.shape) * NOISE


def radius_table() -> pd.DataFrame:
    """One row per path: its radius and speed, and both measures of it."""
    rows = [
        {
            "path": "line" if math.isinf(radius) else "arc",
            "true_radius_m": radius,
            "speed_m_per_step": speed,
            "points": WINDOW,
            "noise_m": NOISE,
            "radius_m": radius_of_curvature(points),
            "pseudo_radius_m": pseudo_radius(points),
        }
        for radius, speed, points in known_paths()
    ]
    return pd.DataFrame(rows)


def radius_figure(table: pd.DataFrame) -> Figure:
    """Measured against true radius, coloured by speed; ours beside the public code's."""
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 5.0)
        panels = figure.subplots(1, 2)
        shades = ScalarMappable(Normalize(1000 * SPEEDS[0], 1000 * SPEEDS[-1]), "viridis")
        for panel, (measure, title, unit) in zip(panels, _MEASURES, strict=True):
            _draw(panel, table, measure, shades)
            panel.set(title=title, ylabel=unit)
        panels[0].set(yscale="log")
        panels[0].yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        panels[1].set_ylim(bottom=0)
        panels[0].plot(RADII, RADII, color=INK, linewidth=1.0, linestyle=":", label="measured = true")
        panels[0].legend(loc="upper left")
        figure.colorbar(shades, ax=panels, label="speed, mm per control step", pad=0.02)
        about = f"{len(table)} synthetic paths of {WINDOW} positions, {1000 * NOISE:g} mm of noise on every coordinate"
        entitle(figure, "Radius of curvature, on arcs and lines of known radius", about)
    return figure


def _draw(panel: Axes, table: pd.DataFrame, measure: str, shades: ScalarMappable) -> None:
    places = table["true_radius_m"].replace(math.inf, _LINE)
    # the speeds of one radius side by side, not on top of one another
    aside = 0.05 * (table["speed_m_per_step"].rank(method="dense") - (len(SPEEDS) + 1) / 2)
    colours = shades.to_rgba(1000 * table["speed_m_per_step"].to_numpy())
    panel.scatter(places * np.exp(aside), table[measure], s=16, c=colours, linewidths=0)
    panel.set(xscale="log", xlabel="true radius, m")
    panel.axvspan(_LINE / 1.35, _LINE * 1.35, color=MUTED, alpha=0.1, linewidth=0)
    panel.set_xlim(RADII[0] / 1.3, _LINE * 1.35)
    panel.xaxis.set_major_locator(FixedLocator([*RADII, _LINE]))
    panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: "line" if x == _LINE else f"{x:g}"))
