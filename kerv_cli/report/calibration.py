"""Print what `kerv calibrate` measured, as tables."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from kerv_cli.methods.calibration import Calibration
from kerv_cli.training.calibration import moving_errors

Table = tuple[tuple[str, ...], list[tuple[object, ...]], str]
"""Column names, rows and title."""


def tables(calibration: Calibration, path: Path) -> Iterator[Table]:
    """Yield tables: K_S and prediction errors of each task, errors of each predictor, and thresholds of each task.

    K_S is the reference level of a task's kinematic variability (docs/methods.md §3). The thresholds say when a
    retrieved chunk may be executed without verification (§4). Without thresholds, the last table is left out.

    Args:
        calibration: The calibration.
        path: Its file, which the title names.
    """
    errors = partial(moving_errors, calibration.errors, space=calibration.target.actions)
    kalman, hold = errors("kalman"), errors("hold")
    columns: tuple[str, ...] = ("task", "fitted on", "tested on", "decodes", "K_S", "Kalman, h=1", "hold, h=1")
    rows: list[tuple[object, ...]] = []
    for number, (name, counts) in enumerate(calibration.demos.tasks.items()):
        row = calibration.variability.get(name)
        levels = [row.decodes, f"{row.k_s:.3f}"] if row else ["-"] * 2
        ahead = (f"{error[number, 0]:.4f}" for error in (kalman, hold))
        rows.append((name, counts["training"], counts["held_out"], *levels, *ahead))
    yield columns, rows, f"calibration in {path}"

    rows = [(kind, *(f"{e:.4f}" for e in errors(kind).mean(0))) for kind in calibration.errors]
    columns = ("predictor", *(f"h={h}" for h in range(1, hold.shape[1] + 1)))
    yield columns, rows, "held-out error of the moving DoFs, mean of tasks, normalised action units"

    skip = calibration.skip
    if skip is None:
        return
    rows = []
    for name, task in skip.tasks.items():
        levels = [f"{x:.4f}" for x in (task.s_min, task.low, task.high)] if task.share else ["never", "-", "-"]
        figures = [f"{task.within:.1%}", f"{task.error:.4f}"] if task.share else ["-", "-"]
        rows.append((name, *levels, f"{task.share:.1%}", *figures, task.entries))
    limit = f"error ≤ {skip.epsilon:g}"
    columns = ("task", "s_min", "low", "high", "would be skipped", limit, "mean error", "entries")
    best = f"best neighbour in another episode, {skip.confidence:.0%} with an error of at most {skip.epsilon:g}"
    yield columns, rows, f"verify-skip, {best}"
