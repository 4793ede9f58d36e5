"""The calibration: figures fitted on training demonstrations (docs/methods.md §3, §4).

`kerv calibrate` writes it. Thresholds, predictors, boundaries and verify-skip read it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from kerv_cli.base.errors import CheckpointError
from kerv_cli.methods.artifacts import Artifact, MadeFor, Use, check_sources
from kerv_cli.methods.heisd.rules import BoundaryRanges
from kerv_cli.methods.kerv.prediction import Noise

FILE = "calibration.json"
NEVER = 1.01  # s_min of a task that never skips: cosines do not exceed 1
AGAIN = "run 'kerv calibrate' again"
Errors = dict[str, dict[str, dict[str, list[float]]]]
"""predictor -> task -> DoF -> mean absolute error 1 … H steps ahead, normalised action units."""


@dataclass(frozen=True)
class Demonstrations:
    """The demonstrations of a calibration.

    Attributes:
        sha256: Their hash.
        tasks: Task -> {"training": episodes, "held_out": episodes}.
    """

    sha256: str
    tasks: dict[str, dict[str, int]]


@dataclass(frozen=True)
class Variability:
    """Distribution of the variability K over a task's pre-sampled decodes, in normalised action units."""

    k_s: float  # the reference level K_S
    decodes: int
    p25: float
    p75: float
    p90: float


@dataclass(frozen=True)
class BoundarySection:
    """Ranges of the hybrid boundary by the number of positions that it looks at (§4.4)."""

    episodes: int
    windows: dict[str, BoundaryRanges]


@dataclass(frozen=True)
class SkipLevel:
    """Verify-skip levels of a task, cosines (§4.3).

    Attributes:
        s_min: Similarity from which a chunk is executed without verification.
        low: Lowest value that feedback may move `s_min` to.
        high: Highest value.
        share: Part of the datastore's entries that `s_min` would skip, each with another episode's best neighbour.
        entries: Entries of the task that were looked up.
        within: Part of the skipped ones whose error is at most epsilon.
        error: Mean error of the skipped ones, normalised action units.
    """

    s_min: float
    low: float
    high: float
    share: float
    entries: int
    within: float | None = None
    error: float | None = None


@dataclass(frozen=True)
class SkipSection:
    """Skip levels by task, for the datastore with this hash."""

    datastore: str
    epsilon: float
    confidence: float
    tasks: dict[str, SkipLevel]


@dataclass(frozen=True)
class Calibration:
    """Contents of `calibration.json`. Sections that were not measured are None or empty."""

    target: MadeFor
    demos: Demonstrations
    window: int  # control steps of history
    noise: dict[str, Noise]  # per kind of filter
    errors: Errors
    variability: dict[str, Variability]
    boundary: BoundarySection | None = None
    skip: SkipSection | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    format: Literal[2] = 2
    kind: Literal["calibration"] = "calibration"

    @property
    def tasks(self) -> Collection[str]:
        """Tasks that have levels."""
        return self.variability

    def k_s(self, task: str) -> float:
        """Return the task's reference level K_S, in normalised action units.

        Raises:
            CheckpointError: The task was not pre-sampled.
        """
        if task not in self.variability:
            raise CheckpointError(
                f"the calibration has no reference level K_S for {task}, only for "
                f"{', '.join(self.variability) or 'no task'}: run 'kerv calibrate task={task}'"
            )
        return self.variability[task].k_s

    def ranges(self, window: int) -> BoundaryRanges:
        """Return the ranges of R and D for a boundary that looks at `window` positions.

        Raises:
            CheckpointError: None were measured, or none for this window.
        """
        if self.boundary is None:
            raise CheckpointError(f"the calibration has no ranges for the boundary: {AGAIN}")
        windows = self.boundary.windows
        if str(window) not in windows:
            raise CheckpointError(
                f"the calibration's ranges were taken over {', '.join(windows)} positions, the boundary looks at "
                f"{window}: run 'kerv calibrate boundary_windows=[{','.join([*windows, str(window)])}]'"
            )
        return windows[str(window)]

    def skip_levels(self, task: str, datastore: str) -> tuple[float, float, float]:
        """Return (low, s_min, high) of the task, cosines in ascending order; NEVER if nothing is skipped.

        Args:
            task: Full name.
            datastore: Hash of the datastore that retrieves.

        Raises:
            CheckpointError: No levels, none for this task, or those of another datastore.
        """
        if self.skip is None:
            raise CheckpointError(f"the calibration has no skip levels: build a datastore, then {AGAIN}")
        what = "the calibration's skip section was fitted"
        check_sources({"datastore": self.skip.datastore}, {"datastore": datastore}, what, AGAIN)
        if task not in self.skip.tasks:
            raise CheckpointError(
                f"the calibration has no skip level for {task}, only for {', '.join(self.skip.tasks)}: {AGAIN}"
            )
        row = self.skip.tasks[task]
        return row.low, row.s_min, row.high


class CalibrationArtifact(Artifact[Calibration]):
    """The calibration: a single file, which its path names."""

    kind = noun = "calibration"
    made, command = "made", ("calibrate",)
    schema = Calibration

    def path(self, results: str, name: str | None, target: Path) -> Path:
        """Return the named calibration, else the target's.

        A shipped one is pretrained/<name>/calibration.json, one made here
        artifacts/calibration/<name>/calibration.json.
        """
        if name is None and target.name == "target":
            return target.parent / FILE
        if name is None and target.parent.name != "target":
            return target / FILE
        return super().path(results, name, target) / FILE

    def json(self, path: Path) -> Path:
        """Return the path itself."""
        return path

    def check_use(self, description: Calibration, use: Use) -> None:
        """Refuse a task without the reference level that the threshold reads."""
        if getattr(use.method["threshold"], "k_s", 0.0) is None:
            for task in use.tasks:
                description.k_s(task)

    def command_beside(self, kinds: Collection[str]) -> tuple[str, ...]:
        """Return the command; without a drafter it pre-samples no decodes."""
        return self.command if "drafter" in kinds else (*self.command, "decodes=0")

    def is_complete(self, description: Calibration, kinds: Collection[str]) -> bool:
        """Return whether it has a section of each source in `kinds`."""
        sections = {"drafter": description.variability, "datastore": description.skip}
        return all(section for kind, section in sections.items() if kind in kinds)

    def made_for(self, description: Calibration) -> MadeFor:
        """Return the target that it was made for."""
        return description.target
