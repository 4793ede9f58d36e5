"""Errors of the kinematic predictors on the actions that a policy itself executed (docs/methods.md §3.1): while
decoding they are shown these, and not the demonstrations' labels on which `kerv calibrate` measures them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from kerv_cli.decoding.calibration_file import Calibration
from kerv_cli.reporting.ceiling import is_autoregressive
from kerv_cli.reporting.prediction import Predictions, error_rows
from kerv_cli.reporting.tables import StudyData
from kerv_cli.settings import REAL
from kerv_cli.studies.plan import Cell
from kerv_cli.studies.store import StudyStore

if TYPE_CHECKING:  # it imports torch, which few reports need
    from kerv_cli.training.predictor_fit import Windows


def own_errors(store: StudyStore, data: StudyData, found: Predictions) -> pd.DataFrame | None:
    """One row per predictor, task, DoF and step ahead, on what the target's autoregressive episodes of a study
    executed; columns as `prediction_table`, and `labels_error`, the error on the demonstrations' labels. None where the
    study has no such episode that is longer than the calibration's window."""
    cells = [cell for cell in _autoregressive(data, found.target) if cell.id in data.cells]
    windows = _windows(store, cells, found.calibration)
    if windows is None:
        return None
    from kerv_cli.training.predictor_fit import prediction_errors

    calibration = found.calibration
    errors = prediction_errors(windows, calibration.noise, calibration.target.actions)
    keys = ["predictor", "task", "dof", "steps_ahead"]
    labels = pd.DataFrame(error_rows(found.target, calibration.errors, {}))[[*keys, "error"]]
    table = pd.DataFrame(error_rows(found.target, errors, windows.episodes)).merge(
        labels.rename(columns={"error": "labels_error"}), on=keys, how="left"
    )
    runs = sorted({str(data.cells[cell.id].status["run"]) for cell in cells})
    return table.assign(
        window=calibration.window,
        calibration_sha256=found.sha256,
        target_sha256=calibration.target.sha256,
        run=";".join(runs),
    )


def _autoregressive(data: StudyData, target: str) -> list[Cell]:
    """The cells of one label that decodes this target autoregressively: the baseline if it does, else the first. Where
    the world goes on during decodes, chunks are not executed whole."""
    cells = [
        c
        for c in data.plan.cells
        if is_autoregressive(c.settings)
        and c.settings["policy"]["target"] == target
        and c.settings.get("rollout", {}).get("clock") != REAL
    ]
    labels = {cell.label for cell in cells}
    chosen = data.plan.baseline if data.plan.baseline in labels else next((cell.label for cell in cells), None)
    return [cell for cell in cells if cell.label == chosen]


def _windows(store: StudyStore, cells: Iterable[Cell], calibration: Calibration) -> Windows | None:
    """Every moment of the cells' episodes, all held out; None where there is none."""
    from kerv_cli.training.predictor_fit import Windows, windows_of

    space, horizon = calibration.target.actions, calibration.target.chunk
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    places: list[str] = []
    counts: dict[str, dict[str, int]] = {}
    for cell in cells:
        for executed in store.executed_actions(cell.id).values():
            actions = space.normalise(executed)
            past, future = windows_of(actions, actions, calibration.window, horizon, len(actions) - horizon + 1)
            if len(past):
                parts.append((past, future))
                places += [cell.task] * len(past)
                counts.setdefault(cell.task, {"training": 0, "held_out": 0})["held_out"] += 1
    if not parts:
        return None
    tasks = tuple(counts)
    past, future = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    numbers = np.array([tasks.index(task) for task in places])
    return Windows(past, future, numbers, np.ones(len(past), dtype=bool), tasks, counts)
