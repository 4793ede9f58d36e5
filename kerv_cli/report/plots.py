"""Draw the figures of a study from its tables, as PNG files.

No display is needed. The same numbers give the same bytes.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import write_bytes
from kerv_cli.report.measures import MICRO, Row
from kerv_cli.report.stressed import by_kind, is_stressed
from kerv_cli.report.tables import is_baseline, is_number, rows_of

INK, MUTED = "#1f2933", "#6b7785"
COLOURS = ("#0b6fb8", "#d1495b", "#2a9d6f", "#8d5fd3", "#e08e1b", "#3aa6b9", "#7a5c3e")  # distinct when colour-blind
MARKERS = "os^Dv"
STYLE: Any = {
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e8ee",
    "axes.axisbelow": True,
    "legend.frameon": False,
}
SUCCESS, SPEED = "success", "episode_speedup"
UNITS = {SUCCESS: "success, % of episodes", SPEED: "speed: time per episode, baseline ÷ setting"}
"""Columns of a study's table that are drawn -> their axis labels."""
_ACROSS = 4  # panels in a row


class Panel(NamedTuple):
    """One panel of a figure: lines of a measure against a number.

    Attributes:
        title: Heading of the panel.
        x: Table column for the x axis.
        xlabel: Label of the x axis.
        y: Table column for the y axis, SUCCESS or SPEED.
        lines: Name of each line -> its table rows. A single row is drawn as a horizontal line.
    """

    title: str
    x: str
    xlabel: str
    y: str
    lines: Mapping[str, Sequence[Row]]


def study_figures(table: pd.DataFrame, axis: str, title: str) -> dict[str, Figure]:
    """Draw the figures that suit a study, from its rows pooled over tasks.

    - A study of stress: success against the level of stress.
    - A study whose settings differ along `axis`: speed and success against it.
    - Any other study that was timed: success against speed.

    Args:
        table: The study's table.
        axis: Table column for the x axis, such as `threshold.r`. Empty: none.
        title: The study's title.

    Returns:
        Ending of the file's name, such as `_tradeoff` -> figure. Empty if there is nothing to draw.
    """
    rows = table[table["averaging"] == MICRO]
    heading = f"{title}\n{about(rows)}"
    if is_stressed(rows):
        panels = [Panel(kind, "stress_level", "level", SUCCESS, lines) for kind, lines in by_kind(table).items()]
        return {"": lines_figure(panels, heading)}
    lines = series_of(rows, axis)
    if any(len(line) > 1 for line in lines.values()):
        return {"": lines_figure([Panel("", axis, axis, y, lines) for y in (SPEED, SUCCESS)], heading)}
    return {"_tradeoff": _tradeoff(rows_of(rows), heading)} if rows[SPEED].notna().any() else {}


def about(rows: pd.DataFrame) -> str:
    """Return the subtitle of a figure: policies, number of tasks and episodes, device, number format."""
    first, targets = rows.iloc[0], list(dict.fromkeys(str(name) for name in rows["policy.target"]))
    names = ", ".join(targets) if len(targets) <= 2 else f"{len(targets)} targets"
    counts = f"{rows['tasks'].max()} tasks, {rows['episodes'].max()} episodes per setting"
    return f"{names} · {counts} · {first['device_name']}, {first['runtime.dtype']}"


def series_of(rows: pd.DataFrame, axis: str) -> dict[str, list[Row]]:
    """Group the settings that differ only along the axis, so that each group can be drawn as a line.

    A row without a number on the axis forms a group of its own.

    Returns:
        Name of the group -> its rows, sorted along the axis.
    """
    series: dict[str, list[Row]] = {}
    for row in rows_of(rows):
        series.setdefault(str(row["series"] if is_number(row.get(axis)) else row["label"]), []).append(row)
    lines = {}
    for name, line in series.items():
        if len(line) == 1:
            lines[str(line[0]["label"])] = line
        else:
            lines[name] = sorted(line, key=lambda row: float(row[axis]))
    return lines


@mpl.rc_context(STYLE)
def lines_figure(panels: Sequence[Panel], heading: str) -> Figure:
    """Draw panels side by side with one legend. A name has the same colour in every panel."""
    names = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    across = min(_ACROSS, len(panels))
    down = -(-len(panels) // across)
    figure = new_figure(max(10.0, 3.4 * across), 1.6 + 3.2 * down, heading)
    handles: dict[str, Any] = {}
    for number, panel in enumerate(panels):
        axes = figure.add_subplot(down, across, number + 1)
        for name, rows in panel.lines.items():
            look = _look(names.index(name), all(map(is_baseline, rows)))
            if len(rows) == 1:
                level = _bar(rows[0], panel.y)[0]
                handles[name] = axes.axhline(level, linewidth=1.2, linestyle="--", color=look["color"])
            else:
                points = [(row[panel.x], *_bar(row, panel.y)) for row in rows if is_number(row[panel.x])]
                x, y, low, high = zip(*points, strict=True)
                handles[name] = axes.errorbar(x, y, yerr=(low, high), elinewidth=1.0, markersize=5, **look)
        axes.set(title=panel.title, xlabel=panel.xlabel, ylabel=UNITS[panel.y])
    columns = min(5, len(handles))
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=columns)
    return figure


@mpl.rc_context(STYLE)
def _tradeoff(rows: Sequence[Row], heading: str) -> Figure:
    """Draw success against speed per episode. A setting without a speed is a horizontal line at its success."""
    figure = new_figure(11.0, 6.0, heading)
    axes = figure.subplots()
    for number, row in enumerate(rows):
        look, name = _look(number, is_baseline(row)), str(row["label"])
        (x, *xerr), (y, *yerr) = _bar(row, SPEED), _bar(row, SUCCESS)
        if math.isnan(x):
            axes.axhline(y, label=name, linewidth=1.2, linestyle="--", color=look["color"])
        else:
            look |= {"xerr": [[end] for end in xerr], "yerr": [[end] for end in yerr]}
            axes.errorbar([x], [y], label=name, elinewidth=1.0, markersize=7, linestyle="", **look)
    axes.axvline(1.0, color=INK, linewidth=1.2, linestyle=":")
    axes.set(title="Success against speed per episode", xlabel=UNITS[SPEED], ylabel=UNITS[SUCCESS])
    figure.legend(loc="outside right upper")
    return figure


def latency_figure(table: pd.DataFrame, heading: str) -> Figure:
    """Draw success against the time that an AR decode takes, with one panel per kind of delay compensation.

    Args:
        table: Table made by `latency_table`.
        heading: Title and subtitle.
    """
    panels: dict[str, dict[str, list[Row]]] = {}
    for row in rows_of(table[table["ar_latency_ms"] > 0].sort_values("ar_latency_ms", kind="stable")):
        lines = panels.setdefault(f"delay compensation: {row['rollout.delay_compensation']}", {})
        lines.setdefault(row["method"], []).append({**row, "baseline": row["ar"]})
    x = ("ar_latency_ms", "an autoregressive decode takes, ms")
    return lines_figure([Panel(title, *x, SUCCESS, lines) for title, lines in panels.items()], heading)


def _bar(row: Row, column: str) -> tuple[float, float, float]:
    """Return a value and the lengths of its error bar to below and above.

    Success is in per cent. All three numbers are NaN if the value is missing.
    """
    if column == SPEED and is_baseline(row):
        return 1.0, 0.0, 0.0  # by definition
    scale = 100.0 if column == SUCCESS else 1.0
    value, low, high = (
        scale * float(row[name]) if is_number(row[name]) else math.nan
        for name in (column, f"{column}_low", f"{column}_high")
    )
    return value, abs(value - low), abs(high - value)


def _look(number: int, baseline: bool) -> dict[str, Any]:
    """Return the colour and marker of a setting.

    Args:
        number: Position of the setting in the legend.
        baseline: Whether it is the baseline, which is drawn in black.
    """
    colour = INK if baseline else COLOURS[number % len(COLOURS)]
    return {"color": colour, "marker": MARKERS[number // len(COLOURS) % len(MARKERS)]}


def new_figure(width: float, height: float, heading: str) -> Figure:
    """Return an empty figure with a heading.

    Args:
        width: In inches.
        height: In inches.
        heading: Title and subtitle.
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(heading, x=0.01, ha="left", fontsize=11)
    return figure


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG file without metadata, so that the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()


def read_log(folder: Path) -> pd.DataFrame:
    """Return the log of a training, one row per validation.

    Args:
        folder: Folder of the trained artifact.

    Raises:
        CheckpointError: The folder has no readable log of a training.
    """
    path = folder / "log.csv"
    try:
        return pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error


@mpl.rc_context(STYLE)
def curves_figure(log: pd.DataFrame, title: str) -> Figure:
    """Draw every measure of a training's log against the training step. Mark the best validation."""
    best = float(log["step"].to_numpy()[int(log["score"].to_numpy().argmax())])
    names = [str(name) for name in log.columns if name != "step"]
    about = f"{len(log)} validations of the averaged weights; dotted: the saved ones, step {best:.0f}"
    figure = new_figure(3.5 * len(names), 3.6, f"{title}\n{about}")
    for panel, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        panel.plot(log["step"], log[name], color=COLOURS[0], marker="o", markersize=3)
        panel.axvline(best, color=MUTED, linewidth=1.0, linestyle=":")
        panel.set(title=name, xlabel="step")
    return figure


def save_curves(folder: Path) -> Path:
    """Write `curves.png` into the folder of a trained artifact and return its path.

    Raises:
        CheckpointError: The folder has no readable log of a training.
        StorageError: The disk is full or read-only.
    """
    path = folder / "curves.png"
    write_bytes(path, png(curves_figure(read_log(folder), f"{folder.parent.name} {folder.name}")))
    return path
