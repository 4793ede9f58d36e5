"""HeiSD's hybrid proposer, acceptance rules, verify-skip and boundaries (docs/methods.md §2.1, §4.3, §4.4).

A boundary chooses the side that drafts, retrieval or the drafter. R is the radius of curvature of the measured
end-effector path, D its length. A straight, fast reach (large R, large D) repeats demonstrated motion; a tight or slow
path is precise work, for which the drafter is better.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.registry import NoSettings
from kerv_cli.engine.acceptance import Acceptance, Accepted, Strict, accept_by_group
from kerv_cli.engine.chunk import Choice, Chunk, Mode
from kerv_cli.engine.draft import Draft, TokenTree
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.context import Context
from kerv_cli.methods.eagle.drafter import DrafterProposer
from kerv_cli.methods.heisd import (
    FusedBoundarySettings,
    HybridAcceptanceSettings,
    HybridProposerSettings,
    RandomBoundarySettings,
    SequenceAcceptanceSettings,
    SimilaritySkipSettings,
)
from kerv_cli.methods.retrieval.datastore import RetrievalProposer
from kerv_cli.methods.spec_vla.rules import Relaxed

LEAST = 3  # positions; fewer have no curvature
STILL = 1e-3  # metres; a hand with a shorter path counts as still (in Meta-World a control step at full speed is 10 mm)
COINCIDENT = 1e-7  # metres of spread; below it float32 positions are the same point
STRAIGHT = 1e-6  # spread across the path by the spread along it; below it the points lie on a line


class HybridProposer(Proposer):
    """HeiSD: retrieval on one side of the boundary, the drafter on the other (docs/methods.md §4.4). name: of the side
    that drafts this chunk."""

    needs_states = True

    def __init__(self, drafter: Proposer, retrieval: Proposer) -> None:
        self.sides: dict[str, Proposer] = {"drafter": drafter, "retrieval": retrieval}
        self.nodes = max(drafter.nodes, retrieval.nodes)
        self.side, self.name = drafter, drafter.name

    @classmethod
    def build(cls, settings: HybridProposerSettings, context: Context) -> HybridProposer:
        """proposer=hybrid."""
        return cls(DrafterProposer.build(settings, context), RetrievalProposer.build(settings, context))

    def prepare(self, chunk: Chunk) -> None:
        """Takes the side that the boundary chose for this chunk."""
        assert chunk.choice is not None, "a hybrid proposer needs a boundary"
        self.side = self.sides[chunk.choice.mode]
        self.name = self.side.name
        self.side.prepare(chunk)

    def begin(self, chunk: Chunk) -> None:
        """Tells the side that drafts."""
        self.side.begin(chunk)

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """The draft of the boundary's side."""
        return self.side.propose(chunk, depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Tells the side that drafts."""
        self.side.committed(chunk, first, hidden, target_tokens)


def retrieval_of(context: Context) -> RetrievalProposer:
    """The retrieval of the method's proposer, where that retrieves; else a new one of the nearest neighbour."""
    proposer: Proposer | None = context.built["proposer"]
    side = proposer.sides["retrieval"] if isinstance(proposer, HybridProposer) else proposer
    return side if isinstance(side, RetrievalProposer) else RetrievalProposer.of_nearest(context)


@dataclass(frozen=True)
class ByGroup(Strict):
    """A kinematic group of one control step is accepted or rejected as a whole; strict DoFs must match. group_limit:
    summed bias of a group, token_limit: bias of a token, bins."""

    group_limit: int
    token_limit: int

    @classmethod
    def build(cls, settings: SequenceAcceptanceSettings, context: Context) -> ByGroup:
        """acceptance=sequence."""
        return cls(context.target.actions, settings.group_limit, settings.token_limit)

    def limits(self, r: int) -> tuple[int, ...]:
        """Largest accepted distance per DoF, bins (D,): `token_limit` whatever r, for strict DoFs 0."""
        return tuple(0 if strict else self.token_limit for strict in self.space.is_strict)

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """The longest path of whole groups, by `accept_by_group`."""
        limits, bounds = self.limits(r), self.space.bounds
        return accept_by_group(tree, target_tokens, start, limits, group_limit=self.group_limit, bounds=bounds)


@dataclass(frozen=True)
class ByProposer:
    """Retrieved drafts by group, all others by distance."""

    retrieved: ByGroup
    others: Relaxed

    @classmethod
    def build(cls, settings: HybridAcceptanceSettings, context: Context) -> ByProposer:
        """acceptance=hybrid."""
        space = context.target.actions
        return cls(ByGroup(space, settings.group_limit, settings.token_limit), Relaxed(space, settings.strict_dofs))

    def of_drafts_from(self, proposer: str) -> Acceptance:
        """The rule for drafts of `proposer`."""
        return self.retrieved if proposer == "retrieval" else self.others

    def limits(self, r: int) -> tuple[int, ...]:
        """Largest accepted distance per DoF of drafts that are not retrieved, bins (D,)."""
        return self.others.limits(r)

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """The longest accepted path of a draft that is not retrieved."""
        return self.others.judge(tree, target_tokens, start, r)


@dataclass(frozen=True)
class SkipLevels:
    """The task's least similarity s_min and the bounds within which feedback moves it; cosines.

    Raises:
        UsageError: they are not in order.
    """

    low: float
    s_min: float
    high: float

    def __post_init__(self) -> None:
        if not self.low <= self.s_min <= self.high:
            raise UsageError(f"verify-skip: s_min {self.s_min} does not lie in {self.low}…{self.high}")


class VerifySkip(Skip):
    """Executes the best neighbour's chunk without verification where its similarity is at least s_min.

    At most `max_skips` decodes in a row; where a boundary decides, only on retrieval's side; and after a stored episode
    was followed to its end, none of its chunks is executed unverified again in this episode. With `up` or `down` above
    0 s_min carries over between episodes: after a failure it rises by `up` times the calibrated range, after a success
    it falls by `down` times it. Results then depend on the order of episodes and on the evaluator's flag.
    """

    def __init__(self, settings: SimilaritySkipSettings, retrieval: RetrievalProposer, levels: SkipLevels) -> None:
        self.settings, self.retrieval, self.levels = settings, retrieval, levels
        self.s_min = levels.s_min
        self.in_a_row = 0
        self.ended: set[int] = set()  # seeds of stored episodes that were executed to their end

    @classmethod
    def build(cls, settings: SimilaritySkipSettings, context: Context) -> VerifySkip:
        """skip=similarity; it shares the retrieval of the method's proposer, where that retrieves."""
        retrieval = retrieval_of(context)
        if settings.s_min is not None:
            return cls(settings, retrieval, SkipLevels(settings.s_min, settings.s_min, settings.s_min))
        levels = context.calibration.skip_levels(context.task, retrieval.datastore.content)
        return cls(settings, retrieval, SkipLevels(*levels))

    def begin(self, task: str, seed: int) -> None:
        """An episode begins."""
        self.in_a_row = 0
        self.ended.clear()

    def finish(self, success: bool) -> None:
        """An episode ended."""
        span = self.levels.high - self.levels.low
        s_min = self.s_min + span * (-self.settings.down if success else self.settings.up)
        self.s_min = min(self.levels.high, max(self.levels.low, s_min))

    def take(self, chunk: Chunk) -> bool:
        """Fills the chunk with the best neighbour's tokens if it may be executed unverified -> whether it did."""
        if chunk.choice is not None and chunk.choice.mode != "retrieval":
            self.in_a_row = 0
            return False
        neighbours = self.retrieval.neighbours(chunk)
        seed = int(neighbours.seeds[0])
        if neighbours.similarity[0] < self.s_min or self.in_a_row >= self.settings.max_skips or seed in self.ended:
            self.in_a_row = 0
            return False
        self.in_a_row += 1
        if neighbours.left[0] <= chunk.steps:
            self.ended.add(seed)
        chunk.skip(neighbours.chunks[0].tolist(), self.retrieval.name)
        return True


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
