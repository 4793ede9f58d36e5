"""Curves of a training, from its log."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import write_bytes
from kerv_cli.lab.runs import Curve
from kerv_cli.report.plots import COLOURS, MUTED, STYLE, new_figure, png


def read_log(folder: Path) -> pd.DataFrame:
    """Return the validations of a training, one row each.

    Raises:
        CheckpointError: The folder has no log, or not one that a training wrote.
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


@mpl.rc_context(STYLE)
def curves_figure(log: pd.DataFrame, title: str) -> Figure:
    """Draw one panel per measure over steps and mark the best validation."""
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
    """Write `curves.png` beside a training's log and return its path.

    Raises:
        CheckpointError: As `read_log`.
        StorageError: The disk is full or read-only.
    """
    path = folder / "curves.png"
    write_bytes(path, png(curves_figure(read_log(folder), f"{folder.parent.name} {folder.name}")))
    return path
