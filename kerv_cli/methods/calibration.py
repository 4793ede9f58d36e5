"""The calibration: numbers measured on training demonstrations (docs/methods.md §3, §4).

`kerv calibrate` writes the calibration. Thresholds, predictors, boundaries and skip rules read it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from kerv_cli.base.errors import CheckpointError
from kerv_cli.engine.record import MEAN
from kerv_cli.methods.artifacts import AGAIN, Artifact, MadeFor, Use, check_sources, measured_again
from kerv_cli.methods.heisd import FusedBoundarySettings
from kerv_cli.methods.heisd.curvature import BoundaryRanges
from kerv_cli.methods.kerv import KinematicThresholdSettings
from kerv_cli.methods.kerv.prediction import Noise

FILE = "calibration.json"
NEVER = 1.01  # s_min of a task that never skips: cosines do not exceed 1


@dataclass(frozen=True)
class Demonstrations:
    """The demonstrations that a calibration used. `tasks[name]["training"]` is the number of a task's episodes."""

    sha256: str
    tasks: dict[str, dict[str, int]]


@dataclass(frozen=True)
class Variability:
    """Typical variability K of a task: how far drafts are from the target's tokens (docs/methods.md §3.2).

    Attributes:
        k_s: Reference level K_S: the median K over the measured decodes, normalised action units.
        levels: Median of each way to compute K, by its name in `MEASURES`. Empty in calibrations before version 1.1.
    """

    k_s: float
    decodes: int
    levels: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class BoundarySection:
    """Ranges of curvature and path length for HeiSD's boundary (docs/methods.md §4.4).

    The keys of `windows` are numbers of hand positions as text, such as `15`.
    """

    episodes: int
    windows: dict[str, BoundaryRanges]


@dataclass(frozen=True)
class SkipLevel:
    """The similarity (cosine) s_min at which verification of a task is skipped (docs/methods.md §4.3).

    A match is a datastore entry and the most similar entry of another episode. A skip rule may move s_min between `low`
    and `high`.

    Attributes:
        share: Share of the matches with a similarity of s_min or more.
        entries: Number of all matches.
        within: Share of good matches among those from s_min on. None if there are none.
        error: Mean absolute difference of the chunks in the matches from s_min on, normalised action units, or None.
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
    """How similar a stored observation must be so that verification is skipped, for one datastore.

    Attributes:
        datastore: Hash of the datastore.
        epsilon: Largest mean absolute difference of the two chunks of a good match, normalised action units.
        confidence: Minimum share of good matches from s_min on.
    """

    datastore: str
    epsilon: float
    confidence: float
    tasks: dict[str, SkipLevel]


@dataclass(frozen=True)
class Calibration:
    """Contents of `calibration.json` (docs/formats.md). A section that was not measured is None or empty.

    `window` is the number of past actions that a predictor reads. The key of `noise` is `kalman`, the filter's name.
    `drafter` is the hash of the drafter on whose drafts `variability` was measured. Empty if unknown.
    """

    target: MadeFor
    demos: Demonstrations
    window: int
    noise: dict[str, Noise]
    variability: dict[str, Variability]
    boundary: BoundarySection | None = None
    skip: SkipSection | None = None
    drafter: str = ""
    provenance: dict[str, Any] = field(default_factory=dict)
    format: Literal[2] = 2
    kind: Literal["calibration"] = "calibration"

    @property
    def tasks(self) -> Collection[str]:
        return self.variability

    def k_s(self, task: str, measure: str = MEAN) -> float:
        """Return the task's reference level K_S of the variability, in normalised action units."""
        if task not in self.variability:
            raise CheckpointError(
                f"the calibration has no reference level K_S for {task}, only for "
                f"{', '.join(self.variability) or 'no task'}: {AGAIN}"
            )
        row = self.variability[task]
        if measure != MEAN and measure not in row.levels:
            raise CheckpointError(
                f"the calibration has no reference level K_S for K as the {measure} tokens: name "
                f"threshold.k_s, or {AGAIN}"
            )
        return row.levels.get(measure, row.k_s)

    def ranges(self, window: int) -> BoundaryRanges:
        if self.boundary is None:
            raise CheckpointError(f"the calibration has no ranges for the boundary: {AGAIN}")
        windows = self.boundary.windows
        if str(window) not in windows:
            raise CheckpointError(
                f"the calibration's ranges were taken over {', '.join(windows)} positions, the boundary looks at "
                f"{window}: " + measured_again(f"boundary_windows=[{','.join([*windows, str(window)])}]")
            )
        return windows[str(window)]

    def skip_levels(self, task: str, datastore: str) -> tuple[float, float, float]:
        """Return the similarity s_min at which the task skips verification, and its bounds, as (low, s_min, high).

        If the task never skips verification, all three are NEVER, which is above every similarity.
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
    """Finds, checks and loads calibrations. Here `path` always means the JSON file, not a folder."""

    kind = noun = "calibration"
    made, command = "made", ("calibrate",)
    schema = Calibration

    def path(self, results: str, name: str | None, target: Path) -> Path:
        if name is None and target.name == "target":
            return target.parent / FILE
        if name is None and target.parent.name != "target":
            return target / FILE
        return super().path(results, name, target) / FILE

    def json(self, path: Path) -> Path:
        return path

    def sources(self, description: Calibration) -> Mapping[str, str]:
        stored = {"datastore": description.skip.datastore if description.skip else "", "drafter": description.drafter}
        return {kind: digest for kind, digest in stored.items() if digest}

    def check_use(self, description: Calibration, use: Use) -> None:
        threshold, boundary = use.method["threshold"], use.method["boundary"]
        if isinstance(boundary, FusedBoundarySettings) and boundary.f_star is None:
            description.ranges(boundary.window).limit(boundary.quantile, boundary.alpha)
        if isinstance(threshold, KinematicThresholdSettings) and threshold.k_s is None:
            for task in use.tasks:
                description.k_s(task, threshold.measure)

    def is_complete(self, description: Calibration, kinds: Collection[str]) -> bool:
        sections = {"drafter": description.variability, "datastore": description.skip}
        return all(section for kind, section in sections.items() if kind in kinds)

    def made_for(self, description: Calibration) -> MadeFor:
        return description.target
