"""Errors of the kinematic predictors on held-out demonstrations, as `kerv calibrate` measured them
(docs/methods.md §3.1): table and figure."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.places import find_target
from kerv_cli.methods.calibration import Calibration, CalibrationArtifact, Errors
from kerv_cli.methods.kinematics.prediction import PREDICTORS
from kerv_cli.report.drawing import INK, STYLE, colour, entitle, new_figure

REFERENCE = "hold"


@dataclass(frozen=True)
class Predictions:
    """The predictors' errors of one target's calibration."""

    target: str
    calibration: Calibration
    sha256: str  # of the calibration's file

    @property
    def name(self) -> str:
        """Stem of the report's files: prediction_<target>, with a folder's path made a file name."""
        return "prediction_" + re.sub(r"[^A-Za-z0-9_.-]+", "-", self.target.removesuffix("/target")).strip("-.")


def read_predictions(results: Path, target: str) -> Predictions | None:
    """The errors in a target's calibration; None without such a target or calibration. The errors depend on the
    demonstrations alone, so they hold for later weights of the target too.

    Raises:
        CheckpointError: the calibration is damaged or of another format.
    """
    try:
        path = CalibrationArtifact().place(str(results), None, find_target(str(results), target))
    except UsageError:  # no such target
        return None
    if not path.is_file():
        return None
    calibration = CalibrationArtifact().read(path)
    return Predictions(target, calibration, sha256_of(path)) if calibration.errors else None


def calibrated_targets(results: Path) -> list[str]:
    """Names of the targets that have a calibration in this results folder."""
    paths = [
        *results.glob("artifacts/calibration/[!.]*/calibration.json"),
        *results.glob("pretrained/[!.]*/calibration.json"),
    ]
    return sorted({path.parent.name for path in paths})


def predicting_targets(settings: Iterable[Mapping[str, Any]]) -> list[str]:
    """The targets of those settings whose method uses a kinematic predictor: for drafts or for compensation."""
    return list(dict.fromkeys(s["policy"]["target"] for s in settings if _predicts(s)))


def _predicts(settings: Mapping[str, Any]) -> bool:
    drafts = [settings.get(kind, {"kind": "none"}) for kind in ("prefill_draft", "proposer")]
    names = {name for part in drafts for name in (part["kind"], *part.get("sources", ()), *part.get("fallback", ()))}
    return bool(names & set(PREDICTORS) or settings["rectifier"]["kind"] == "compensate")


def prediction_table(predictions: Predictions) -> pd.DataFrame:
    """One row per predictor, task, DoF and step ahead; errors in normalised action units."""
    calibration, errors = predictions.calibration, predictions.calibration.errors
    origin = {
        "window": calibration.window,
        "calibration_sha256": predictions.sha256,
        "target_sha256": calibration.target.sha256,
        "demos_sha256": calibration.demos.sha256,
        "git_commit": calibration.provenance.get("git_commit", ""),
    }
    return pd.DataFrame(_rows(predictions.target, errors, calibration.demos.tasks)).assign(**origin)


def _rows(target: str, errors: Errors, episodes: Mapping[str, Mapping[str, int]]) -> list[dict[str, Any]]:
    """episodes: task -> how many were held_out and how many training."""
    rows = []
    for predictor, tasks in errors.items():
        for task, dofs in tasks.items():
            counts = episodes.get(task, {})
            held_out = {"held_out_episodes": counts.get("held_out"), "training_episodes": counts.get("training")}
            for dof, steps in dofs.items():
                for step, error in enumerate(steps):
                    hold = errors.get(REFERENCE, {}).get(task, {}).get(dof, [])
                    head = {"target": target, "predictor": predictor, "task": task, "dof": dof}
                    rows.append(head | {"steps_ahead": step + 1} | _against(error, hold[step : step + 1]) | held_out)
    return rows


def _against(error: float, hold: list[float]) -> dict[str, float]:
    reference = hold[0] if hold else math.nan
    ratio = error / reference if reference else math.nan  # a gripper's error is often 0
    return {"error": error, "hold_error": reference, "ratio_to_hold": ratio}


def predicted_dofs(table: pd.DataFrame) -> list[str]:
    """The DoFs in which some predictor differs from holding the last action (strict DoFs are held by all of them); all
    DoFs if there is none."""
    differs = set(table.loc[table["error"] != table["hold_error"], "dof"])
    dofs = list(dict.fromkeys(table["dof"]))
    return [dof for dof in dofs if dof in differs] or dofs


def predicted_means(table: pd.DataFrame) -> pd.DataFrame:
    """Mean error over `predicted_dofs`: columns predictor, task, steps_ahead, error."""
    rows = table[table["dof"].isin(predicted_dofs(table))]
    return rows.groupby(["predictor", "task", "steps_ahead"], sort=False)["error"].mean().reset_index()


def prediction_summary(table: pd.DataFrame) -> pd.DataFrame:
    """One row per predictor, as text: by steps ahead the mean error over `predicted_dofs` and all tasks, and its share
    of hold's error."""
    means = predicted_means(table).groupby(["predictor", "steps_ahead"], sort=False)["error"].mean().reset_index()
    errors = {(str(p), int(s)): float(e) for p, s, e in means.itertuples(index=False)}
    rows: dict[str, dict[str, str]] = {}
    for (predictor, step), error in errors.items():
        hold = errors.get((REFERENCE, step), 0.0)
        text = f" ({100 * error / hold:.0f} %)" if hold and predictor != REFERENCE else ""
        rows.setdefault(predictor, {"predictor": predictor})[f"{step} ahead"] = f"{error:.4f}{text}"
    return pd.DataFrame(rows.values())


def prediction_figure(title: str, table: pd.DataFrame) -> Figure:
    """Error against steps ahead, one line per predictor, and every task's error one step ahead."""
    means = predicted_means(table)
    predictors, tasks = list(dict.fromkeys(means["predictor"])), list(dict.fromkeys(means["task"]))
    with mpl.rc_context(STYLE):
        figure = new_figure(11.5, max(4.8, 1.9 + len(tasks) * (0.1 + 0.085 * len(predictors))))
        ahead, by_task = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
        colours = {name: INK if name == REFERENCE else colour(i) for i, name in enumerate(predictors)}
        _draw_ahead(ahead, means, colours)
        _draw_tasks(by_task, means[means["steps_ahead"] == 1], tasks, colours)
        handles, labels = ahead.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        held_out = table.drop_duplicates("task")["held_out_episodes"].sum()
        about = f"mean of {', '.join(predicted_dofs(table))} · {len(tasks)} tasks, {held_out:.0f} held-out episodes"
        about += f" · from the last {table['window'][0]} steps"
        entitle(figure, title, about)
    return figure


def _draw_ahead(panel: Axes, means: pd.DataFrame, colours: Mapping[str, str]) -> None:
    for name, shade in colours.items():
        by_step = means[means["predictor"] == name].groupby("steps_ahead")["error"]
        middle, low, high = by_step.mean(), by_step.quantile(0.25), by_step.quantile(0.75)
        steps = middle.index.to_numpy()
        style = (0, (4, 2)) if name == REFERENCE else "-"
        panel.plot(steps, middle, color=shade, marker="o", markersize=5, linewidth=1.8, linestyle=style, label=name)
        panel.fill_between(steps, low, high, color=shade, alpha=0.1, linewidth=0)
        panel.set_xticks(steps)
    panel.set(title="Steps ahead", xlabel="control steps ahead", ylabel="mean abs error, normalised action units")
    panel.set_ylim(bottom=0)
    panel.text(0.02, 0.97, "band: quartiles of the tasks", transform=panel.transAxes, fontsize=8, va="top")


def _draw_tasks(panel: Axes, first: pd.DataFrame, tasks: list[str], colours: Mapping[str, str]) -> None:
    y, thickness = np.arange(len(tasks)), 0.84 / len(colours)
    for i, (name, shade) in enumerate(colours.items()):
        errors = first[first["predictor"] == name].set_index("task")["error"].reindex(tasks)
        offset = (i - (len(colours) - 1) / 2) * thickness
        panel.barh(y + offset, errors, 0.9 * thickness, color=shade, linewidth=0)
    panel.set_yticks(y, tasks, color=INK)
    panel.set_ylim(len(tasks) - 0.5, -0.5)
    panel.grid(axis="y", visible=False)
    panel.set(title="One step ahead, by task", xlabel="mean abs error, normalised action units")
