"""Curves of a training: what its log.csv holds, drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import MOST_TEXT, regular, write_bytes
from kerv_cli.report.drawing import COLOURS, MUTED, STYLE, entitle, figure_bytes, new_figure

_COLUMNS = 3  # panels beside one another
_FEW = 4  # validations: their curves show less than the loss of every step


def read_log(folder: Path) -> pd.DataFrame:
    """The validations of a training, one row each.

    Raises:
        CheckpointError: no log there, or not one that a training wrote.
    """
    path = folder / "log.csv"
    try:
        log = pd.read_csv(regular(path, MOST_TEXT))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    if "step" not in log or log.empty or pd.to_numeric(log["step"], errors="coerce").isna().any():
        raise CheckpointError(f"{path} is not the log of a training")
    return log


def curves_figure(log: pd.DataFrame, title: str) -> Figure:
    """One panel per measure over steps; the best validation is marked."""
    names = [str(name) for name in log.columns if name != "step"]
    rows = -(-len(names) // _COLUMNS)
    score = log["score"] if "score" in log else log["step"]
    best = float(log["step"].to_numpy()[int(score.to_numpy().argmax())])
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


def loss_figure(losses: Sequence[float], title: str) -> Figure:
    """The loss of every step of a run that is too short for curves of validations."""
    with mpl.rc_context(STYLE):
        figure = new_figure(7.0, 3.6)
        panel = figure.subplots()
        panel.plot(range(1, len(losses) + 1), losses, color=COLOURS[0], linewidth=1.5)
        panel.set(xlabel="step", ylabel="loss")
        entitle(figure, title, f"loss per step of training, {len(losses)} steps")
    return figure


def save_curves(folder: Path, losses: Sequence[float]) -> Path:
    """Writes `curves.png` beside a training's log.csv -> its path. losses: of every step; drawn where there are fewer
    than `_FEW` validations.

    Raises:
        CheckpointError: as `read_log`. StorageError: the disk refused.
    """
    path = folder / "curves.png"
    log, title = read_log(folder), f"{folder.parent.name} {folder.name}"
    figure = (
        loss_figure(losses, title) if any(map(math.isfinite, losses)) and len(log) < _FEW else curves_figure(log, title)
    )
    write_bytes(path, figure_bytes(figure, "png"))
    return path
