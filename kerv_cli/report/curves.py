"""Curves of a training: what its log.csv holds, drawn."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import write_bytes
from kerv_cli.lab.runs import Curve
from kerv_cli.report.drawing import COLOURS, MUTED, STYLE, entitle, figure_bytes, new_figure

_COLUMNS = 3  # panels beside one another


def read_log(folder: Path) -> pd.DataFrame:
    """The validations of a training, one row each.

    Raises:
        CheckpointError: no log there, or not one that a training wrote.
    """
    rows = Curve.of(folder).read() if folder.parent.parent.name == "artifacts" else []
    if rows:
        return pd.DataFrame(rows)
    path = folder / "log.csv"  # travels with an artifact, also without its database
    try:
        log = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    if "step" not in log or log.empty or pd.to_numeric(log["step"], errors="coerce").isna().any():
        raise CheckpointError(f"{path} is not the log of a training")
    return log


def curves_figure(log: pd.DataFrame, title: str) -> Figure:
    """One panel per measure over steps; the best validation is marked."""
    names = [str(name) for name in log.columns if name != "step"]
    rows = -(-len(names) // _COLUMNS)
    best = float(log["step"].to_numpy()[int(log["score"].to_numpy().argmax())])
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 1.0 + 2.3 * rows)
        panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
        for panel, name in zip(panels, names, strict=False):
            panel.plot(log["step"], log[name], color=COLOURS[0], linewidth=1.8, marker="o", markersize=3)
            panel.axvline(best, color=MUTED, linewidth=1.0, linestyle=":")
            panel.set(title=name, xlabel="step")
        for panel in panels[len(names) :]:
            panel.set_visible(False)
        about = f"{len(log)} validations of the averaged weights; dotted: the saved ones, step {best:.0f}"
        entitle(figure, title, about)
    return figure


def save_curves(folder: Path) -> Path:
    """Writes `curves.png` beside a training's log.csv -> its path.

    Raises:
        CheckpointError: as `read_log`. StorageError: the disk refused.
    """
    path = folder / "curves.png"
    write_bytes(path, figure_bytes(curves_figure(read_log(folder), f"{folder.parent.name} {folder.name}")))
    return path
