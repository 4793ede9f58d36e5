"""HeiSD's proposers, acceptance rules, skip rule and boundaries (docs/methods.md §2.1, §4.2 to §4.4).

A boundary chooses for each chunk whether retrieval or the drafter drafts. It looks at the hand's last measured
positions: R is their radius of curvature, D the length of their path. A straight, fast path (large R, large D) repeats
demonstrated motion, so retrieval drafts. A curved or slow path is precise work, for which the drafter is better.
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
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
from kerv_cli.engine.parts import Boundary, Skip
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

CROSS = 0.1  # assumed probability that a path of retrieved groups changes to another neighbour after a group
LEAST = 3  # minimum number of positions for a curvature
POINTS = 100  # number of windows of the demonstrations that a calibration keeps
STILL = 1e-3  # metres; a hand with a shorter path is at rest (in Meta-World, a control step at full speed is 10 mm)
COINCIDENT = 1e-7  # metres; float32 positions with a smaller spread are the same point
STRAIGHT = 1e-6  # points form a line if their spread across it is less than this share of the spread along it


def neighbour_tree(
    chunks: np.ndarray,
    start: int,
    space: ActionSpace,
    nodes: int = 50,
    depth: int | None = None,
    cross: float = CROSS,
) -> Draft:
    """Merge the neighbours' chunks into one tree of kinematic groups (docs/methods.md §4.2).

    A kinematic group is the position, rotation or gripper tokens of one control step. Every path of the tree consists
    of whole groups. After a group, a path may continue with the next group of any neighbour. There is one exception: a
    group of strict DoFs (the gripper) must come from a neighbour that also has the group before it.

    If the tree would be too large, the most probable groups are kept (*ours*). The i-th neighbour has the weight 1 / i,
    and a path changes to another neighbour with probability `cross`.

    Args:
        chunks: (k, N) tokens, most similar neighbour first.
        start: Number of committed tokens. The tree begins after them.
        space: The action space.
        nodes: Maximum number of nodes of the tree.
        depth: Maximum number of tokens on a path. None: up to the chunk's end.
        cross: Probability of a change after a group. 0: paths never change, so only whole chunks are merged.
    """
    stop = chunks.shape[1] if depth is None else min(chunks.shape[1], start + depth)
    continuations = _Continuations(chunks.tolist(), list(space.segments(start, stop)), cross)
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    # groups to add: (−log probability of their path, order of offers, parent node, number of groups before, tokens,
    # `last` and `whole` as in _Continuations)
    waiting: list[tuple[float, int, int, int, tuple[int, ...], int, int]] = []
    order = count()

    def offer(parent: int, level: int, last: int, whole: int, cost: float) -> None:
        for surprise, group, members, common in continuations.on(level, last, whole):
            heappush(waiting, (cost + surprise, next(order), parent, level, group, members, common))

    offer(ROOT, 0, continuations.everyone, continuations.everyone, 0.0)
    while waiting and len(tokens) < nodes:
        cost, _, node, level, group, last, whole = heappop(waiting)
        known = 0  # number of leading tokens of the group that are in the tree already
        while known < len(group) and (node, group[known]) in children:
            node, known = children[node, group[known]], known + 1
        if len(tokens) + len(group) - known > nodes:
            continue  # never add a group in part
        for token in group[known:]:
            children[node, token] = len(tokens)
            parents.append(node)
            node = len(tokens)
            tokens.append(token)
        offer(node, level + 1, last, whole, cost)
    return Draft.of(tokens, parents)


@functools.lru_cache(maxsize=4096)
def _weight(members: int) -> float:
    """Return the summed weight of the neighbours in a bit set. The i-th neighbour, counted from 1, has weight 1 / i."""
    return sum([1 / (1 + i) for i in range(members.bit_length()) if members >> i & 1])


class _Continuations:
    """Lists the kinematic groups of tokens that may come next on a path of the tree, with their probabilities.

    Retrieval returns stored chunks, the neighbours. Their tokens are cut into kinematic groups. A caller describes the
    groups chosen so far by two sets of neighbours, `last` and `whole`, whose bits stand for neighbours. `last` has the
    neighbours whose chunk contains the last chosen group. `whole` has those whose chunk contains every chosen group. If
    there are none, `whole` is set to `last`.

    Args:
        rows: Tokens of each neighbour's chunk, most similar neighbour first.
        cuts: For each group: index of its first token, index after its last token, whether its DoFs are strict.
        cross: Probability that a path changes to another neighbour after a group.
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
        """List the groups that may be chosen next, those of the most similar neighbours first.

        Args:
            level: Number of groups chosen so far.
            last: Bit set of the neighbours that have the last chosen group.
            whole: Bit set of the neighbours that have every chosen group.

        Yields:
            (−log probability of the group, its tokens, and `last` and `whole` if this group is chosen).
        """
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
    """Drafts the task's most similar stored chunks, merged into one tree (docs/methods.md §4.2).

    Args:
        datastore: The stored chunks.
        target: The target, which encodes the observations.
        neighbours: Number of stored chunks in the tree.
        nodes: Maximum number of nodes of the tree.
    """

    name = "retrieval"

    def __init__(self, datastore: Datastore, target: ReadableTarget, neighbours: int, nodes: int) -> None:
        self.datastore, self.target, self.count, self.nodes = datastore, target, neighbours, nodes
        self._nearest: tuple[Chunk, Neighbours] | None = None

    @classmethod
    def build(cls, settings: RetrievalProposerSettings | HybridProposerSettings, context: Context) -> RetrievalProposer:
        """Build the part that proposer=retrieval chooses, or that proposer=hybrid contains."""
        return cls(context.artifact("datastore"), context.target, settings.neighbours, settings.nodes)

    def neighbours(self, chunk: Chunk) -> Neighbours:
        """Return the stored entries most similar to the chunk's observation. The search runs once per chunk.

        Also store the highest similarity in `chunk.similarity`.
        """
        if self._nearest is None or self._nearest[0] is not chunk:
            pooled = read(self.datastore.pooled(chunk.prompt, self.target))[0]
            key = self.datastore.key_of(pooled.astype(np.float32, copy=False))
            self._nearest = chunk, self.datastore.query(key, chunk.situation.task, self.count)
            chunk.similarity = float(self._nearest[1].similarity[0])
        return self._nearest[1]

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return the most similar stored chunks, as one tree of at most `depth` tokens per path."""
        chunks = self.neighbours(chunk).chunks[:, : chunk.size]
        return neighbour_tree(chunks, len(chunk.tokens), chunk.space, self.nodes, depth)

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return one chain per stored chunk: its tokens after the committed tokens. The most similar chunk is first."""
        start = len(chunk.tokens)
        return self.neighbours(chunk).chunks[:, start : min(chunk.size, start + depth)].tolist()


class HybridProposer(Proposer):
    """HeiSD: drafts by retrieval or with the drafter, as the boundary chooses for each chunk (docs/methods.md §4.4).

    Attributes:
        name: Name of the proposer that drafts the current chunk.
    """

    def __init__(self, drafter: Proposer, retrieval: Proposer) -> None:
        self.proposers: dict[str, Proposer] = {"drafter": drafter, "retrieval": retrieval}
        self.nodes = max(drafter.nodes, retrieval.nodes)
        self.chosen, self.name = drafter, drafter.name

    @classmethod
    def build(cls, settings: HybridProposerSettings, context: Context) -> HybridProposer:
        """Build the hybrid proposer, which `proposer=hybrid` chooses."""
        return cls(EagleDrafter.proposer(settings, context), RetrievalProposer.build(settings, context))

    def begin(self, chunk: Chunk) -> None:
        """Select the proposer that the boundary chose for this chunk, and let it begin the chunk."""
        assert chunk.choice is not None, "a hybrid proposer needs a boundary"
        self.chosen = self.proposers[chunk.choice.mode]
        self.name = self.chosen.name
        self.chosen.begin(chunk)

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return the draft of the selected proposer."""
        return self.chosen.propose(chunk, depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Let the selected proposer learn from the round; arguments as `Proposer.committed`."""
        self.chosen.committed(chunk, first, hidden, target_tokens)


@dataclass(frozen=True)
class GroupRule(DistanceRule):
    """Accepts or rejects each kinematic group (position, rotation, gripper) of a control step as a whole.

    Strict DoFs, such as the gripper, must equal the target's tokens.

    Attributes:
        group_limit: Largest accepted sum of a group's distances to the target's tokens, in bins.
        token_limit: Largest accepted distance of one token, in bins.
    """

    group_limit: int
    token_limit: int

    @classmethod
    def build(cls, settings: SequenceAcceptanceSettings, context: Context) -> GroupRule:
        """Build the part that the setting `acceptance=sequence` chooses."""
        return cls(context.target.actions, settings.group_limit, settings.token_limit)

    def limits(self, r: int) -> tuple[int, ...]:
        """Return the largest accepted distance of each of the D DoFs, in bins: `token_limit`, or 0 for strict DoFs.

        The radius `r` is not used.
        """
        return tuple(0 if strict else self.token_limit for strict in self.space.is_strict)

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """Return the longest accepted path of whole groups.

        Args:
            tree: The draft tree.
            target_tokens: The target's prediction after the last committed token, then after each node.
            start: Number of committed tokens. A node at depth d is token start + d of the chunk.
            r: Not used.
        """
        limits, bounds = self.limits(r), self.space.bounds
        return accept_by_group(tree, target_tokens, start, limits, group_limit=self.group_limit, bounds=bounds)


@dataclass(frozen=True, kw_only=True)
class HybridRule(RelaxedRule):
    """Accepts retrieved drafts by kinematic group, and all other drafts token by token within a radius.

    Attributes:
        retrieved: The rule for retrieved drafts.
    """

    retrieved: GroupRule

    def of_drafts_from(self, proposer: str) -> DistanceRule:
        """Return the rule for the drafts of the proposer with this name."""
        return self.retrieved if proposer == "retrieval" else self


def by_proposer(settings: HybridAcceptanceSettings, context: Context) -> HybridRule:
    """Build the part that the setting `acceptance=hybrid` chooses."""
    return HybridRule(context.target.actions, settings.strict_dofs, retrieved=GroupRule.build(settings, context))


class VerifySkip(Skip):
    """Executes the most similar stored chunk without verification if its similarity is at least s_min.

    At most `max_skips` chunks in a row are executed without verification. If the method has a boundary, the boundary
    must choose retrieval. Once a stored episode has been executed to its end, none of its chunks is executed without
    verification again in the same episode of the robot.

    With `up` or `down` above 0, s_min changes after each episode. A failure raises it by `up` times the calibrated
    range (high − low), a success lowers it by `down` times the range. Then results depend on the order of the episodes.
    """

    def __init__(
        self, settings: SimilaritySkipSettings, retrieval: RetrievalProposer, levels: tuple[float, float, float]
    ) -> None:
        """Start with the calibrated s_min.

        Args:
            settings: Settings of skip=similarity.
            retrieval: Finds the most similar stored chunks.
            levels: The task's (low, s_min, high), as cosines. s_min may change after each episode, between low and
                high.
        """
        self.settings, self.retrieval = settings, retrieval
        self.low, self.s_min, self.high = levels
        self.in_a_row = 0
        self.ended: set[int] = set()  # seeds of stored episodes that were executed to their end

    @classmethod
    def build(cls, settings: SimilaritySkipSettings, context: Context) -> VerifySkip:
        """Build skip=similarity. If the method's proposer also retrieves, the search runs only once for both."""
        proposer: Proposer | None = context.built["proposer"]
        retrieval = proposer.proposers["retrieval"] if isinstance(proposer, HybridProposer) else proposer
        if not isinstance(retrieval, RetrievalProposer):
            retrieval = RetrievalProposer(context.artifact("datastore"), context.target, neighbours=1, nodes=1)
        if settings.s_min is not None:
            return cls(settings, retrieval, (settings.s_min,) * 3)
        manifest = retrieval.datastore.manifest
        return cls(settings, retrieval, context.calibration.skip_levels(context.task, manifest.content))

    def begin(self, task: str, seed: int) -> None:
        """Begin an episode: count skips from 0, and forget which stored episodes were executed to their end."""
        self.in_a_row = 0
        self.ended.clear()

    def finish(self, success: bool) -> None:
        """End an episode: raise s_min, the similarity needed to skip, after a failure; lower it after a success."""
        span = self.high - self.low
        s_min = self.s_min + span * (-self.settings.down if success else self.settings.up)
        self.s_min = min(self.high, max(self.low, s_min))

    def take(self, chunk: Chunk) -> bool:
        """Fill the chunk with the most similar stored chunk, if it may be executed without verification.

        Returns:
            Whether the chunk was filled.
        """
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
    """Fit a circle to a path, and return its radius in metres.

    The radius is infinite for fewer than three points, for a hand at rest and for a straight line. The points are
    projected onto their best plane (by SVD). Taubin's algebraic method, which is exact on arcs, fits the circle. For
    this, the points (x, y) are centred, and divided by `scale`, their root mean square distance from the centre. Let
    z = x² + y². Let (a, b, c) be the right singular vector for the smallest singular value of the matrix with rows
    [(z − 1) / 2, x, y]. Then the radius is scale / |a|.

    Args:
        points: (n, 3) positions, metres.
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

    A range goes from the minimum to the 95th percentile. The infinite radii of straight paths do not count, because
    they would make the range infinite.

    Attributes:
        radius_low: Minimum of R.
        radius_high: 95th percentile of R.
        length_low: Minimum of D.
        length_high: 95th percentile of D.
        points: R and D, both scaled to [0, 1], of about a hundred windows. They are evenly spread in the order of
            R + D, so for α = 0.5 they give the quantiles of F. Empty in calibrations before version 1.1.

    Raises:
        CheckpointError: A range is empty or not finite.
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
    def fit(cls, paths: Iterable[np.ndarray], window: int, known: BoundaryRanges | None = None) -> BoundaryRanges:
        """Measure the ranges over all windows that a boundary would see, including short ones when an episode begins.

        Args:
            paths: Measured hand positions of each episode, (T, 3) metres.
            window: Number of positions in a window.
            known: Ranges to keep, if only `points` is to be measured.

        Raises:
            CheckpointError: No path is curved, or the hand never moves.
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
        ranges = known or cls(float(radii.min()), next(high), float(lengths.min()), next(high))
        scaled = sorted((ranges.normalise(*one) for one in measured), key=sum)
        kept = (np.arange(POINTS) + 0.5) / POINTS * len(scaled)
        # rounded down, so that windows whose F is the limit itself reach it
        points = np.floor(np.array([scaled[int(i)] for i in kept]) * 1e4) / 1e4
        return replace(ranges, points=tuple((radius, length) for radius, length in points.tolist()))

    def limit(self, quantile: float, alpha: float) -> float:
        """Return the limit F*: a quantile of F over the windows of the demonstrations.

        Args:
            quantile: Share of the windows whose F is smaller.
            alpha: Weight of the radius. The length has the weight 1 − alpha.

        Raises:
            CheckpointError: The calibration holds no points, because an earlier version made it.
        """
        if not self.points:
            raise CheckpointError(
                "the calibration has no quantiles of F for boundary.quantile: run 'kerv calibrate complete=true' for "
                "the policy, or name the limit with boundary.f_star"
            )
        radii, lengths = np.array(self.points).T
        return float(np.quantile(alpha * radii + (1 - alpha) * lengths, quantile))

    def normalise(self, radius: float, length: float) -> tuple[float, float]:
        """Scale a path's radius and length (metres) by the ranges. Return both in [0, 1].

        An infinite radius becomes 1 for a straight path, and 0 for a hand at rest.
        """
        scaled = 0.0
        if length >= STILL:
            scaled = min(1.0, max(0.0, (radius - self.radius_low) / (self.radius_high - self.radius_low)))
        return scaled, min(1.0, max(0.0, (length - self.length_low) / (self.length_high - self.length_low)))

    def fused(self, radius: float, length: float, alpha: float) -> float:
        """Return F, the weighted sum of a path's scaled radius and scaled length, in [0, 1].

        Args:
            radius: Radius of curvature, metres.
            length: Path length, metres.
            alpha: Weight of the radius. The length has the weight 1 − alpha.
        """
        radius, length = self.normalise(radius, length)
        return alpha * radius + (1 - alpha) * length


class Random(Boundary):
    """Chooses retrieval with probability p, else the drafter: a baseline that does not look at the path.

    With p = 1 retrieval drafts all chunks, with p = 0 the drafter drafts all. An episode's random numbers depend only
    on the boundary's seed, the task's full name and the episode's seed.
    """

    def __init__(self, p: float, seed: int = 0) -> None:
        self.p, self.seed, self.random = p, seed, np.random.default_rng(seed)

    @classmethod
    def build(cls, settings: RandomBoundarySettings, context: Context) -> Random:
        """Build the part that the setting `boundary=random` chooses."""
        return cls(settings.p, settings.seed)

    @classmethod
    def always(cls, settings: NoSettings, context: Context) -> Random:
        """Build boundary=always_retrieval or boundary=always_drafter, which make the same choice for every chunk."""
        return cls(float(settings.kind == "always_retrieval"))

    def reset(self, task: str, seed: int) -> None:
        """Begin an episode: seed the random numbers."""
        self.random = np.random.default_rng([self.seed, zlib.crc32(task.encode()), seed])

    def choose(self, path: np.ndarray) -> Choice:
        """Choose retrieval with probability p, else the drafter. The path is not used."""
        return Choice("retrieval" if self.random.random() < self.p else "drafter")


@dataclass(frozen=True)
class Fused(Boundary):
    """Chooses retrieval if F ≥ F*. F is the weighted sum of the path's radius of curvature and length, both scaled.

    With fewer than three positions it chooses the drafter.

    Attributes:
        ranges: Ranges that scale radius and length.
        alpha: Weight of the radius. The length has the weight 1 − alpha.
        window: Number of newest positions to look at.
        f_star: The limit F*.
    """

    ranges: BoundaryRanges
    alpha: float
    window: int
    f_star: float

    @classmethod
    def build(cls, settings: FusedBoundarySettings, context: Context) -> Fused:
        """Build the part that the setting `boundary=fused` chooses."""
        ranges = context.calibration.ranges(settings.window)
        f_star = settings.f_star
        if f_star is None:
            f_star = ranges.limit(settings.quantile, settings.alpha)
        return cls(ranges, settings.alpha, settings.window, f_star)

    def choose(self, path: np.ndarray) -> Choice:
        """Choose retrieval or the drafter from the newest `window` positions of the path (m, 3), in metres."""
        points = np.asarray(path)[-self.window :]
        if len(points) < LEAST:
            return Choice("drafter")
        metric = self.ranges.fused(radius_of_curvature(points), path_length(points), self.alpha)
        return Choice("retrieval" if metric >= self.f_star else "drafter", metric)
