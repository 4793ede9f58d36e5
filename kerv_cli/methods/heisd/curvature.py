"""Curvature and length of the hand's path, by which HeiSD's boundary chooses who drafts (docs/methods.md §4.4)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from kerv_cli.base.errors import CheckpointError
from kerv_cli.engine.record import path_length
from kerv_cli.methods.artifacts import AGAIN
from kerv_cli.methods.heisd import LEAST

POINTS = 100  # number of windows of the demonstrations that a calibration keeps
STILL = 1e-3  # metres; a hand with a shorter path is at rest (in Meta-World, a control step at full speed is 10 mm)
COINCIDENT = 1e-7  # metres; float32 positions with a smaller spread are the same point
STRAIGHT = 1e-6  # points form a line if their spread across it is less than this share of the spread along it


def radius_of_curvature(points: np.ndarray) -> float:
    """Fit a circle to a path (n, 3) by Taubin's algebraic method, and return its radius. All in metres.

    The radius is infinite for fewer than three points, for a hand at rest and for a straight line. The points (x, y) in
    the plane that fits best (by SVD) are centred, and divided by `scale`, their root mean square distance from the
    centre. With z = x² + y² and (a, b, c) the right singular vector for the smallest singular value of the matrix with
    rows [(z − 1) / 2, x, y], the radius is scale / |a|.
    """
    points = np.asarray(points, dtype=np.float64)
    if len(points) < LEAST:
        return math.inf
    centred = points - points.mean(0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    if spread[0] <= COINCIDENT or spread[1] <= STRAIGHT * spread[0]:
        return math.inf
    planar = centred @ axes[:2].T
    scale = math.sqrt(float((planar**2).sum(1).mean()))
    planar /= scale
    conic = np.column_stack([((planar**2).sum(1) - 1) / 2, planar])
    quadratic = abs(float(np.linalg.svd(conic, full_matrices=False)[2][-1, 0]))
    return scale / quadratic if quadratic > 0 else math.inf


@dataclass(frozen=True)
class BoundaryRanges:
    """Ranges of the hand's radius of curvature R and path length D in the training demonstrations, in metres.

    A range goes from the minimum to the 95th percentile. The infinite radii of straight paths do not count.

    Attributes:
        points: Pairs (scaled R, scaled D), each in [0, 1], of POINTS windows, evenly chosen from all windows sorted by
            R + D. The quantiles of F are computed from these. Empty in calibrations before version 1.1.
    """

    radius_low: float
    radius_high: float
    length_low: float
    length_high: float
    points: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        pairs = ((self.radius_low, self.radius_high), (self.length_low, self.length_high))
        if not all(0 <= low < high < math.inf for low, high in pairs):
            raise CheckpointError(f"{self} is no range: build it from demonstrations in which the hand moves")

    @classmethod
    def fit(cls, paths: Iterable[np.ndarray], window: int) -> BoundaryRanges:
        """Measure the ranges over all windows of up to `window` hand positions. Paths are (T, 3) in metres."""
        measured = []
        for path in paths:
            for end in range(LEAST, len(path) + 1):
                points = path[max(0, end - window) : end]
                measured.append((radius_of_curvature(points), path_length(points)))
        radii, lengths = np.array(measured).reshape(-1, 2).T
        radii = radii[np.isfinite(radii)]
        if not len(radii):
            raise CheckpointError("the demonstrations hold no curved path: the boundary's ranges cannot be taken")
        high = (float(np.percentile(x, 95)) for x in (radii, lengths))
        ranges = cls(float(radii.min()), next(high), float(lengths.min()), next(high))
        scaled = sorted((ranges.normalise(*one) for one in measured), key=sum)
        kept = (np.arange(POINTS) + 0.5) / POINTS * len(scaled)
        # rounded down, so that windows whose F is the limit itself reach it
        points = np.floor(np.array([scaled[int(i)] for i in kept]) * 1e4) / 1e4
        return replace(ranges, points=tuple((radius, length) for radius, length in points.tolist()))

    def limit(self, quantile: float, alpha: float) -> float:
        """Return the limit F*: a quantile of F over the windows of the demonstrations."""
        if not self.points:
            raise CheckpointError(
                "the calibration has no quantiles of F for boundary.quantile: name the limit with boundary.f_star, "
                f"or {AGAIN}"
            )
        radii, lengths = np.array(self.points).T
        return float(np.quantile(alpha * radii + (1 - alpha) * lengths, quantile))

    def normalise(self, radius: float, length: float) -> tuple[float, float]:
        """Scale a path's radius and length (metres) to [0, 1] by these ranges, and clip them.

        An infinite radius becomes 1 for a straight path, and 0 for a hand at rest.
        """
        scaled = 0.0
        if length >= STILL:
            scaled = min(1.0, max(0.0, (radius - self.radius_low) / (self.radius_high - self.radius_low)))
        return scaled, min(1.0, max(0.0, (length - self.length_low) / (self.length_high - self.length_low)))

    def fused(self, radius: float, length: float, alpha: float) -> float:
        radius, length = self.normalise(radius, length)
        return alpha * radius + (1 - alpha) * length

    def of_path(self, points: np.ndarray, alpha: float) -> float:
        """Return F of a path (n, 3) in metres: alpha · radius of curvature + (1 − alpha) · length, both scaled."""
        return self.fused(radius_of_curvature(points), path_length(points), alpha)
