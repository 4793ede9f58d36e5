"""Print what `kerv calibrate` measured, as tables."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from kerv_cli.methods.calibration import Calibration

Table = tuple[tuple[str, ...], list[tuple[object, ...]], str]
"""Column names, rows and title."""


def tables(calibration: Calibration, path: Path) -> Iterator[Table]:
    """Yield tables: K_S of each task, and thresholds of each task.

    K_S is the reference level of a task's kinematic variability (docs/methods.md §3). The thresholds say when a
    retrieved chunk may be executed without verification (§4). Without thresholds, the last table is left out.

    Args:
        calibration: The calibration.
        path: The calibration's file, named in the title of the tables.
    """
    columns: tuple[str, ...] = ("task", "fitted on", "decodes", "K_S")
    rows: list[tuple[object, ...]] = []
    for name, counts in calibration.demos.tasks.items():
        row = calibration.variability.get(name)
        levels = [row.decodes, f"{row.k_s:.3f}"] if row else ["-"] * 2
        rows.append((name, counts["training"], *levels))
    yield columns, rows, f"calibration in {path}"

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
