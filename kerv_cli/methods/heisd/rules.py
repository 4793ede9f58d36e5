"""HeiSD's proposers, acceptance rules, verify-skip and boundaries (docs/methods.md §2.1, §4.2 to §4.4).

A boundary chooses who drafts: retrieval or the drafter. R is the radius of curvature of the hand's measured path, D its
length. A straight, fast reach (large R, large D) repeats demonstrated motion. A tight or slow path is precise work, for
which the drafter is better.
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count

import numpy as np
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.registry import NoSettings
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.acceptance import Accepted, DistanceRule, accept_by_group
from kerv_cli.engine.chunk import Choice, Chunk
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import ChainProposer, Proposer
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.engine.record import path_length
from kerv_cli.engine.transfer import read
from kerv_cli.engine.tree import ROOT, TokenTree
from kerv_cli.methods.context import Context
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.heisd import (
    FusedBoundarySettings,
    HybridAcceptanceSettings,
    HybridProposerSettings,
    RandomBoundarySettings,
    RetrievalProposerSettings,
    SequenceAcceptanceSettings,
    SimilaritySkipSettings,
)
from kerv_cli.methods.heisd.datastore import Datastore, Neighbours
from kerv_cli.methods.spec_vla import RelaxedRule

CROSS = 0.1  # probability that a path of retrieved groups changes to other neighbours
LEAST = 3  # positions; fewer have no curvature
STILL = 1e-3  # metres; a hand with a shorter path counts as still (in Meta-World a control step at full speed is 10 mm)
COINCIDENT = 1e-7  # metres of spread; below it float32 positions are the same point
STRAIGHT = 1e-6  # spread across the path by the spread along it; below it the points lie on a line


def neighbour_tree(
    chunks: np.ndarray,
    start: int,
    space: ActionSpace,
    nodes: int = 50,
    depth: int | None = None,
    cross: float = CROSS,
) -> Draft:
    """Return the neighbours' chunks after `start` committed tokens as one tree by kinematic group (§4.2).

    A path consists of whole groups. After each it may go on with any neighbour's next group. But a group of strict DoFs
    always comes from a neighbour that has the group before it too. The most probable groups are kept (*ours*): the i-th
    neighbour weighs 1 / i, and a path changes to other neighbours with probability `cross`.

    Args:
        chunks: (k, N) tokens, best neighbour first.
        start: Number of committed tokens.
        space: The action space.
        nodes: Most nodes of the tree.
        depth: Most tokens of a path; None for up to the chunk's end.
        cross: 0 merges only whole chunks.
    """
    stop = chunks.shape[1] if depth is None else min(chunks.shape[1], start + depth)
    continuations = _Continuations(chunks.tolist(), list(space.segments(start, stop)), cross)
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    waiting: list[tuple[float, int, int, int, tuple[int, ...], int, int]] = []
    order = count()

    def offer(parent: int, level: int, last: int, whole: int, cost: float) -> None:
        for surprise, group, members, common in continuations.on(level, last, whole):
            heappush(waiting, (cost + surprise, next(order), parent, level, group, members, common))

    offer(ROOT, 0, continuations.everyone, continuations.everyone, 0.0)
    while waiting and len(tokens) < nodes:
        cost, _, node, level, group, last, whole = heappop(waiting)
        known = 0  # leading tokens of the group that the tree already has
        while known < len(group) and (node, group[known]) in children:
            node, known = children[node, group[known]], known + 1
        if len(tokens) + len(group) - known > nodes:
            continue  # a group is in the tree as a whole or not at all
        for token in group[known:]:
            children[node, token] = len(tokens)
            parents.append(node)
            node = len(tokens)
            tokens.append(token)
        offer(node, level + 1, last, whole, cost)
    return Draft.of(tokens, parents)


@functools.lru_cache(maxsize=4096)
def _weight(members: int) -> float:
    """Return the summed weight of a bit set of neighbours; the i-th, counted from 1, weighs 1 / i."""
    return sum([1 / (1 + i) for i in range(members.bit_length()) if members >> i & 1])


class _Continuations:
    """The groups that may follow a path.

    Two bit sets of neighbours describe a path: `last` have its last group, and `whole` among them have all its groups.
    """

    def __init__(self, rows: list[list[int]], cuts: list[tuple[int, int, bool]], cross: float) -> None:
        self.everyone = (1 << len(rows)) - 1
        self.cross = cross
        self.levels: list[tuple[bool, list[tuple[tuple[int, ...], int]]]] = []
        for first, last, strict in cuts:
            givers: dict[tuple[int, ...], int] = {}
            for i, row in enumerate(rows):
                group = tuple(row[first:last])
                givers[group] = givers.get(group, 0) | 1 << i
            self.levels.append((strict, list(givers.items())))

    def on(self, level: int, last: int, whole: int) -> Iterator[tuple[float, tuple[int, ...], int, int]]:
        """Yield (−log probability, the group's tokens, the two sets of the longer path), best neighbour first."""
        if level == len(self.levels):
            return
        strict, givers = self.levels[level]
        pool = self.everyone
        if strict:
            pool = last
            givers = [(group, members & last) for group, members in givers if members & last]
            givers.sort(key=lambda way: way[1] & -way[1])
        cross, of_whole, of_pool = self.cross, _weight(whole), _weight(pool)
        for group, members in givers:
            common = members & whole
            probability = (1 - cross) * _weight(common) / of_whole + cross * _weight(members) / of_pool
            if probability > 0:
                yield -math.log(probability), group, members, common or members


class RetrievalProposer(ChainProposer):
    """The nearest stored chunks of the task, merged by kinematic group (docs/methods.md §4.2)."""

    name = "retrieval"

    def __init__(self, datastore: Datastore, target: ReadableTarget, neighbours: int, nodes: int) -> None:
        self.datastore, self.target, self.count, self.nodes = datastore, target, neighbours, nodes
        self.waits = target.device.type == "cpu"
        self._nearest: tuple[Chunk, Neighbours] | None = None

    @classmethod
    def build(cls, settings: RetrievalProposerSettings | HybridProposerSettings, context: Context) -> RetrievalProposer:
        """Build proposer=retrieval, and retrieval's part of proposer=hybrid."""
        return cls(context.artifact("datastore"), context.target, settings.neighbours, settings.nodes)

    def neighbours(self, chunk: Chunk) -> Neighbours:
        """Return the task's entries nearest to this observation, searched once per chunk. Sets `chunk.similarity`."""
        if self._nearest is None or self._nearest[0] is not chunk:
            self._search(chunk, read(self.datastore.pooled(chunk.prompt, self.target))[0])
        assert self._nearest is not None
        return self._nearest[1]

    def prepare(self, chunk: Chunk) -> None:
        """Add the pooled prompt, which the search key is made of, to `chunk.reads`."""
        if not self.waits and (self._nearest is None or self._nearest[0] is not chunk):
            vector = self.datastore.pooled(chunk.prompt, self.target)
            chunk.reads.append((vector, lambda pooled: self._search(chunk, pooled)))

    def _search(self, chunk: Chunk, pooled: np.ndarray) -> None:
        key = self.datastore.key_of(pooled.astype(np.float32, copy=False))
        self._nearest = chunk, self.datastore.query(key, chunk.situation.task, self.count)
        chunk.similarity = float(self._nearest[1].similarity[0])

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return the neighbours' chunks as one tree."""
        chunks = self.neighbours(chunk).chunks[:, : chunk.size]
        return neighbour_tree(chunks, len(chunk.tokens), chunk.space, self.nodes, depth)

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return each neighbour's remaining tokens as a chain, best neighbour first."""
        start = len(chunk.tokens)
        return self.neighbours(chunk).chunks[:, start : min(chunk.size, start + depth)].tolist()


class HybridProposer(Proposer):
    """HeiSD: lets retrieval or the drafter draft, as the boundary says (docs/methods.md §4.4).

    Attributes:
        name: Of the one that drafts this chunk.
    """

    needs_states = True

    def __init__(self, drafter: Proposer, retrieval: Proposer) -> None:
        self.proposers: dict[str, Proposer] = {"drafter": drafter, "retrieval": retrieval}
        self.nodes = max(drafter.nodes, retrieval.nodes)
        self.chosen, self.name = drafter, drafter.name

    @classmethod
    def build(cls, settings: HybridProposerSettings, context: Context) -> HybridProposer:
        """Build proposer=hybrid."""
        return cls(EagleDrafter.proposer(settings, context), RetrievalProposer.build(settings, context))

    def prepare(self, chunk: Chunk) -> None:
        """Take the proposer that the boundary chose for this chunk."""
        assert chunk.choice is not None, "a hybrid proposer needs a boundary"
        self.chosen = self.proposers[chunk.choice.mode]
        self.name = self.chosen.name
        self.chosen.prepare(chunk)

    def begin(self, chunk: Chunk) -> None:
        """Tell the chosen proposer."""
        self.chosen.begin(chunk)

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return the draft of the chosen proposer."""
        return self.chosen.propose(chunk, depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Tell the chosen proposer."""
        self.chosen.committed(chunk, first, hidden, target_tokens)


@dataclass(frozen=True)
class GroupRule(DistanceRule):
    """Accepts or rejects a kinematic group of one control step as a whole; strict DoFs must match.

    Attributes:
        group_limit: Largest summed bias of a group, bins.
        token_limit: Largest bias of a token, bins.
    """

    group_limit: int
    token_limit: int

    @classmethod
    def build(cls, settings: SequenceAcceptanceSettings, context: Context) -> GroupRule:
        """Build acceptance=sequence."""
        return cls(context.target.actions, settings.group_limit, settings.token_limit)

    def limits(self, r: int) -> tuple[int, ...]:
        """Return the largest accepted distance per DoF, bins (D,): `token_limit` whatever r, 0 for strict DoFs."""
        return tuple(0 if strict else self.token_limit for strict in self.space.is_strict)

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """Return the longest path of whole groups, by `accept_by_group`."""
        limits, bounds = self.limits(r), self.space.bounds
        return accept_by_group(tree, target_tokens, start, limits, group_limit=self.group_limit, bounds=bounds)


@dataclass(frozen=True, kw_only=True)
class HybridRule(RelaxedRule):
    """Judges retrieved drafts by group, all others within one radius."""

    retrieved: GroupRule

    def of_drafts_from(self, proposer: str) -> DistanceRule:
        """Return the rule for drafts of `proposer`."""
        return self.retrieved if proposer == "retrieval" else self


def by_proposer(settings: HybridAcceptanceSettings, context: Context) -> HybridRule:
    """Build acceptance=hybrid."""
    space = context.target.actions
    by_group = GroupRule(space, settings.group_limit, settings.token_limit)
    return HybridRule(space, settings.strict_dofs, retrieved=by_group)


class VerifySkip(Skip):
    """Executes the best neighbour's chunk without verification if its similarity is at least s_min.

    It does so for at most `max_skips` decodes in a row, and with a boundary only where retrieval drafts. After a stored
    episode was followed to its end, none of its chunks is executed unverified again in this episode. With `up` or
    `down` above 0, s_min carries over between episodes: a failure raises it by `up` times the calibrated range, a
    success lowers it by `down` times. Results then depend on the order of episodes and on the evaluator's success flag.
    """

    def __init__(
        self, settings: SimilaritySkipSettings, retrieval: RetrievalProposer, levels: tuple[float, float, float]
    ) -> None:
        """Start with the calibrated level.

        Args:
            settings: Those of skip=similarity.
            retrieval: Finds the neighbours.
            levels: The task's (low, s_min, high), cosines. Feedback moves s_min between low and high.
        """
        self.settings, self.retrieval = settings, retrieval
        self.low, self.s_min, self.high = levels
        self.in_a_row = 0
        self.ended: set[int] = set()  # seeds of stored episodes that were executed to their end

    @classmethod
    def build(cls, settings: SimilaritySkipSettings, context: Context) -> VerifySkip:
        """Build skip=similarity. It shares the retrieval of the method's proposer, if that retrieves."""
        proposer: Proposer | None = context.built["proposer"]
        retrieval = proposer.proposers["retrieval"] if isinstance(proposer, HybridProposer) else proposer
        if not isinstance(retrieval, RetrievalProposer):
            retrieval = RetrievalProposer(context.artifact("datastore"), context.target, neighbours=1, nodes=1)
        if settings.s_min is not None:
            return cls(settings, retrieval, (settings.s_min,) * 3)
        return cls(settings, retrieval, context.calibration.skip_levels(context.task, retrieval.datastore.content))

    def begin(self, task: str, seed: int) -> None:
        """Begin an episode."""
        self.in_a_row = 0
        self.ended.clear()

    def finish(self, success: bool) -> None:
        """End an episode."""
        span = self.high - self.low
        s_min = self.s_min + span * (-self.settings.down if success else self.settings.up)
        self.s_min = min(self.high, max(self.low, s_min))

    def take(self, chunk: Chunk) -> bool:
        """Fill the chunk with the best neighbour's tokens if it may be executed unverified -> whether it did."""
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
    """Return the radius in metres of the circle through points (n, 3); infinite if there is no circle.

    The points are projected onto their best plane by singular values, then fitted by Taubin's algebraic method, which
    is exact on arcs. Centred and scaled to unit mean square, the fit's smallest singular vector (a, b, c) over [(z − 1)
    / 2, x, y] with z = x² + y² gives R = scale / |a|. Fewer than three points, a hand at rest and a straight line have
    no circle.
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
    """Ranges of R and D over the training demonstrations: minimum and 95th percentile, metres.

    Infinite radii are left out: one straight reach would make every other radius zero.

    Raises:
        CheckpointError: No range between finite numbers.
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
        """Return the ranges over every window that decoding would see, also the short ones at an episode's beginning.

        Args:
            paths: (T, 3) measured positions of whole episodes, metres.
            window: Positions of a window.

        Raises:
            CheckpointError: No path bends, or none moves.
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
        """Return (R̂, D̂), clipped to [0, 1].

        R̂ is 1 for a straight reach and 0 for a hand at rest, both of infinite radius.
        """
        scaled = 0.0
        if length >= STILL:
            scaled = min(1.0, max(0.0, (radius - self.radius_low) / (self.radius_high - self.radius_low)))
        return scaled, min(1.0, max(0.0, (length - self.length_low) / (self.length_high - self.length_low)))

    def fused(self, radius: float, length: float, alpha: float) -> float:
        """Return F = α·R̂ + (1 − α)·D̂, in [0, 1]."""
        radius, length = self.normalise(radius, length)
        return alpha * radius + (1 - alpha) * length


class Seeded:
    """Base of boundaries."""

    seed = 0

    def numbers(self, task: str, seed: int) -> np.random.Generator:
        """Return an episode's generator. It depends on the boundary's seed, the task and the episode's seed alone."""
        return np.random.default_rng([self.seed, zlib.crc32(task.encode()), seed])


@dataclass(frozen=True)
class Random(Seeded):
    """Retrieval with probability p, without looking at the path: a control.

    With 1 and 0 one proposer drafts all chunks.
    """

    p: float
    seed: int = 0

    @classmethod
    def build(cls, settings: RandomBoundarySettings, context: Context) -> Random:
        """Build boundary=random."""
        return cls(settings.p, settings.seed)

    @classmethod
    def always(cls, settings: NoSettings, context: Context) -> Random:
        """Build boundary=always_retrieval or always_drafter."""
        return cls(float(settings.kind == "always_retrieval"))

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        """Choose retrieval with probability p, else the drafter."""
        return Choice("retrieval" if rng.random() < self.p else "drafter")


@dataclass(frozen=True)
class Fused(Seeded):
    """Retrieval if F ≥ F*; the drafter with fewer than three positions."""

    ranges: BoundaryRanges
    alpha: float
    window: int
    f_star: float

    @classmethod
    def build(cls, settings: FusedBoundarySettings, context: Context) -> Fused:
        """Build boundary=fused."""
        ranges = context.calibration.ranges(settings.window)
        return cls(ranges, settings.alpha, settings.window, settings.f_star)

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        """Choose by F of the path's newest `window` positions (m, 3), metres."""
        points = np.asarray(path)[-self.window :]
        if len(points) < LEAST:
            return Choice("drafter")
        metric = self.ranges.fused(radius_of_curvature(points), path_length(points), self.alpha)
        return Choice("retrieval" if metric >= self.f_star else "drafter", metric)
