"""Which side of a hybrid proposer drafts, retrieval or the drafter (docs/methods.md §4.4; HeiSD).

R is the radius of curvature of the measured end-effector path, D its length. A straight, fast reach (large R, large D)
repeats demonstrated motion; a tight or slow path is precise work, for which the drafter is better.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.registry import NoSettings
from kerv_cli.engine.chunk import Choice, Mode
from kerv_cli.methods.context import Context
from kerv_cli.methods.heisd import FusedBoundarySettings, RandomBoundarySettings

LEAST = 3  # positions; fewer have no curvature
STILL = 1e-3  # metres; a hand with a shorter path counts as still (in Meta-World a control step at full speed is 10 mm)
COINCIDENT = 1e-7  # metres of spread; below it float32 positions are the same point
STRAIGHT = 1e-6  # spread across the path by the spread along it; below it the points lie on a line


def radius_of_curvature(points: np.ndarray) -> float:
    """Radius in metres of the circle through points (n, 3); infinite where there is no circle.

    The best-fit plane by singular values, in it Taubin's algebraic circle fit, which is exact on arcs. Centred and
    scaled to unit mean square, the fit's smallest singular vector (a, b, c) over [(z − 1) / 2, x, y], z = x² + y²,
    gives R = scale / |a|. Infinite for fewer than three points, a hand at rest and a straight line.

    Raises:
        ValueError: points of another shape.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have shape {points.shape}, not (n, 3)")
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


def path_length(points: np.ndarray) -> float:
    """Summed distances between successive points (n, 3), metres; 0 for fewer than two."""
    points = np.asarray(points, dtype=np.float64)
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


@dataclass(frozen=True)
class BoundaryRanges:
    """Ranges of R and D over the training demonstrations: minimum and 95th percentile, metres.

    Infinite radii (straight lines, a hand at rest) are left out: one straight reach would make every other radius zero.

    Raises:
        CheckpointError: no range between finite numbers.
    """

    radius_low: float
    radius_high: float
    length_low: float
    length_high: float

    def __post_init__(self) -> None:
        pairs = ((self.radius_low, self.radius_high), (self.length_low, self.length_high))
        if not all(0 <= low < high < math.inf for low, high in pairs):
            raise CheckpointError(f"{self} is no range: build it from demonstrations in which the hand moves")

    @classmethod
    def fit(cls, paths: Iterable[np.ndarray], window: int) -> BoundaryRanges:
        """Ranges over every window that decoding would see, including the short ones at an episode's beginning.

        paths: (T, 3) measured positions of whole episodes, metres.

        Raises:
            CheckpointError: no path bends, or none moves.
        """
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
        return cls(float(radii.min()), next(high), float(lengths.min()), next(high))

    def normalise(self, radius: float, length: float) -> tuple[float, float]:
        """(R̂, D̂) in [0, 1], clipped. R̂ is 1 for an infinite radius of a moving hand (a straight reach) and 0 for a hand
        at rest, whose radius is infinite too."""
        scaled = 0.0
        if length >= STILL:
            scaled = min(1.0, max(0.0, (radius - self.radius_low) / (self.radius_high - self.radius_low)))
        return scaled, min(1.0, max(0.0, (length - self.length_low) / (self.length_high - self.length_low)))

    def fused(self, radius: float, length: float, alpha: float) -> float:
        """F = α·R̂ + (1 − α)·D̂, in [0, 1]."""
        radius, length = self.normalise(radius, length)
        return alpha * radius + (1 - alpha) * length


class Seeded:
    """Base of all boundaries: the episode's generator."""

    seed = 0

    def numbers(self, task: str, seed: int) -> np.random.Generator:
        """The generator of an episode; depends on the boundary's seed, task and episode seed alone."""
        return np.random.default_rng([self.seed, zlib.crc32(task.encode()), seed])


@dataclass(frozen=True)
class Always(Seeded):
    """One side for all chunks."""

    mode: Mode

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> Always:
        """boundary=always_retrieval, always_drafter."""
        return cls("retrieval" if settings.kind == "always_retrieval" else "drafter")

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        """`mode`, whatever the path."""
        return Choice(self.mode)


@dataclass(frozen=True)
class Random(Seeded):
    """Retrieval with probability p, without looking at the path: a control."""

    p: float
    seed: int = 0

    @classmethod
    def build(cls, settings: RandomBoundarySettings, context: Context) -> Random:
        """boundary=random."""
        return cls(settings.p, settings.seed)

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        """Retrieval with probability p, else the drafter."""
        return Choice("retrieval" if rng.random() < self.p else "drafter")


@dataclass(frozen=True)
class Fused(Seeded):
    """F ≥ F* → retrieval; fewer than three positions → drafter."""

    ranges: BoundaryRanges
    alpha: float
    window: int
    f_star: float

    @classmethod
    def build(cls, settings: FusedBoundarySettings, context: Context) -> Fused:
        """boundary=fused."""
        ranges = context.calibration.ranges(settings.window)
        return cls(ranges, settings.alpha, settings.window, settings.f_star)

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        """The side by F of the path's newest `window` positions (m, 3), metres, and F."""
        points = np.asarray(path)[-self.window :]
        if len(points) < LEAST:
            return Choice("drafter")
        metric = self.ranges.fused(radius_of_curvature(points), path_length(points), self.alpha)
        return Choice("retrieval" if metric >= self.f_star else "drafter", metric)
