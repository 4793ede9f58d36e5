"""The calibration file: what was fitted on training demonstrations, read back and checked (METHODS §3, §4).

`kerv calibrate` writes it (training/calibration.py); thresholds, predictors, boundaries and verify-skip read it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from kerv_cli.decoding.boundary import LEAST, BoundaryRanges
from kerv_cli.drafting.kinematics import FILTERS, HORIZON, MINIMUM, Noise, Predictor, build_predictor
from kerv_cli.errors import CheckpointError, UsageError
from kerv_cli.files import read_json, write_json
from kerv_cli.settings import ThresholdSettings
from kerv_cli.spaces import GRIPPER

FORMAT = 1
NEVER = 1.01  # a similarity that no neighbour reaches: the task is never skipped
Errors = dict[str, dict[str, dict[str, list[float]]]]


@dataclass(frozen=True)
class Calibration:
    """What `calibration.json` holds. `boundary` (§4.4), `skip` (§4.3) and `variability` may be empty."""

    target: dict[str, Any]  # {"sha256", "chunk", "dofs"}
    demos: dict[str, Any]  # {"sha256", "tasks": {task: {"training": episodes, "held_out": episodes}}}
    window: int  # control steps of history
    noise: dict[str, Noise]  # per kind of filter
    errors: Errors
    variability: dict[str, dict[str, float]]  # task -> {"k_s", "decodes", "p25", "p75", "p90"}
    boundary: dict[str, Any] = field(
        default_factory=dict
    )  # {"episodes", "windows": {positions: a BoundaryRanges' fields}}
    skip: dict[str, Any] = field(
        default_factory=dict
    )  # {"datastore", "epsilon", "confidence", "tasks": {task: levels}}
    provenance: dict[str, Any] = field(default_factory=dict)

    def k_s(self, task: str) -> float:
        """The task's reference level K_S, normalised action units.

        Raises:
            CheckpointError: the task was not pre-sampled.
        """
        if task not in self.variability:
            raise CheckpointError(
                f"the calibration has no reference level K_S for {task}, only for "
                f"{', '.join(self.variability) or 'no task'}: run 'kerv calibrate task={task}'"
            )
        return float(self.variability[task]["k_s"])

    def threshold(self, settings: ThresholdSettings, task: str) -> ThresholdSettings:
        """`settings` with the task's K_S, where the kind needs one and none was given."""
        if settings.kind not in ("kinematic", "change") or settings.k_s is not None:
            return settings
        return replace(settings, k_s=self.k_s(task))

    def ranges(self, window: int) -> BoundaryRanges:
        """What the boundary's R and D are normalised with when it looks at `window` positions.

        Raises:
            CheckpointError: none were taken, or none over so many positions.
        """
        if not self.boundary:
            raise CheckpointError("the calibration has no ranges for the boundary: run 'kerv calibrate' again")
        windows = self.boundary["windows"]
        if str(window) not in windows:
            raise CheckpointError(
                f"the calibration's ranges were taken over {', '.join(windows)} positions, the boundary looks at "
                f"{window}: run 'kerv calibrate boundary_windows=[{','.join([*windows, str(window)])}]'"
            )
        return BoundaryRanges(**windows[str(window)])

    def skip_levels(self, task: str, datastore_sha256: str) -> tuple[float, float, float]:
        """(low, s_min, high) of the task: cosine similarities, low <= s_min <= high; NEVER where nothing is skipped.

        datastore_sha256: of the manifest of the datastore that retrieves.

        Raises:
            CheckpointError: no levels, none for this task, or those of another datastore.
        """
        again = "run 'kerv calibrate' again"
        if not self.skip:
            raise CheckpointError(f"the calibration has no skip levels: build a datastore, then {again}")
        if self.skip["datastore"] != datastore_sha256:
            raise CheckpointError(
                f"the calibration's skip levels are those of datastore {self.skip['datastore'][:12]}, not of "
                f"{datastore_sha256[:12]}: {again}"
            )
        if task not in self.skip["tasks"]:
            raise CheckpointError(
                f"the calibration has no skip level for {task}, only for {', '.join(self.skip['tasks'])}: {again}"
            )
        row = self.skip["tasks"][task]
        return float(row["low"]), float(row["s_min"]), float(row["high"])

    def predictor(self, kind: str, minimum: int = MINIMUM, horizon: int = HORIZON) -> Predictor:
        """The predictor `kind` with the fitted noise.

        Raises:
            UnknownName: no such predictor.
        """
        return build_predictor(kind, int(self.target["dofs"]), self.noise, minimum, self.window, horizon, GRIPPER)


def calibration_beside(target: Path) -> Path:
    """Shipped: pretrained/<name>/calibration.json; made here: artifacts/calibration/<name>/calibration.json."""
    if target.name == "target":
        return target.parent / "calibration.json"
    if target.parent.name == "target":
        return target.parent.parent / "calibration" / target.name / "calibration.json"
    return target / "calibration.json"


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Writes `calibration` atomically."""
    write_json(path, {"format": FORMAT, "kind": "calibration", **asdict(calibration)})


def load_calibration(path: Path, target_sha256: str, chunk: int) -> Calibration:
    """The calibration at `path`, which must have been made for this target.

    Raises:
        CheckpointError: missing, damaged, of another format, target or chunk length.
    """
    if not path.is_file():
        raise CheckpointError(f"no calibration at {path}: run 'kerv calibrate'")
    value = read_json(path)
    if not isinstance(value, dict) or (value.get("format"), value.get("kind")) != (FORMAT, "calibration"):
        raise CheckpointError(f"{path} is not a calibration of format {FORMAT}: run 'kerv calibrate' again")
    try:
        del value["format"], value["kind"]
        value["noise"] = {
            k: Noise(**{n: tuple(map(float, x)) for n, x in v.items()}) for k, v in value["noise"].items()
        }
        loaded = Calibration(**value)
        _check(loaded)
    except (KeyError, TypeError, ValueError, AttributeError, UsageError) as error:
        raise CheckpointError(f"{path} is damaged ({error}): run 'kerv calibrate' again") from error
    if loaded.target["chunk"] != chunk:
        steps = loaded.target["chunk"]
        raise CheckpointError(f"{path} was made for chunks of {steps} steps, not of {chunk}: run 'kerv calibrate'")
    if loaded.target["sha256"] != target_sha256:
        raise CheckpointError(
            f"{path} was made for target {str(loaded.target['sha256'])[:12]}, not for {target_sha256[:12]}: "
            "run 'kerv calibrate'"
        )
    return loaded


def _check(loaded: Calibration) -> None:
    """Raises ValueError, KeyError or TypeError where a figure is missing or impossible."""
    dofs = int(loaded.target["dofs"])
    if not {"sha256", "chunk"} <= set(loaded.target):
        raise ValueError("it does not name its target")
    if set(loaded.noise) != set(FILTERS) or any(len(noise.q) != dofs for noise in loaded.noise.values()):
        raise ValueError("the noise of a filter is missing")
    if not isinstance(loaded.window, int) or loaded.window < MINIMUM:
        raise ValueError(f"window {loaded.window}")
    if any(not (math.isfinite(row["k_s"]) and row["k_s"] > 0) for row in loaded.variability.values()):
        raise ValueError("a reference level is not a number above 0")
    if not isinstance(loaded.boundary, dict) or not isinstance(loaded.skip, dict):
        raise ValueError("boundary and skip must be sections")
    if loaded.boundary:
        _check_boundary(loaded)
    if loaded.skip:
        _check_skip(loaded.skip)


def _check_boundary(loaded: Calibration) -> None:
    for window, ranges in loaded.boundary["windows"].items():
        if not window.isdigit() or int(window) < LEAST:
            raise ValueError(f"boundary window {window}")
        try:
            BoundaryRanges(**{name: float(value) for name, value in ranges.items()})
        except CheckpointError as error:
            raise ValueError(f"boundary: {error}") from error


def _check_skip(skip: dict[str, Any]) -> None:
    if not isinstance(skip["datastore"], str) or not skip["tasks"]:
        raise ValueError("skip does not name its datastore or has no task")
    for task, row in skip["tasks"].items():
        if not -NEVER <= row["low"] <= row["s_min"] <= row["high"] <= NEVER:
            raise ValueError(f"the skip levels of {task} are not in order")
