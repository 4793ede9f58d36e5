"""HeiSD (docs/methods.md §2.1, §4): drafts by retrieval or by the drafter, and skipped verification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base import registry
from kerv_cli.base.limits import MOST_BINS, MOST_DECODES, MOST_TOKENS, number
from kerv_cli.engine.acceptance import Accepted, DistanceRule, accept_by_group
from kerv_cli.engine.decisions import Choice, SkipDecision, TokenTree
from kerv_cli.engine.parts import Boundary, Skip
from kerv_cli.engine.proposer import ChainProposer, Proposer
from kerv_cli.methods.eagle import DrafterProposerSettings, only_of_trees
from kerv_cli.methods.spec_vla import RelaxedRule

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.draft import Draft
    from kerv_cli.methods.context import Context
    from kerv_cli.methods.heisd.curvature import BoundaryRanges
    from kerv_cli.methods.heisd.datastore import Datastore, Neighbours

MANIFEST = "manifest.json"
LEAST = 3  # minimum number of positions for a curvature


# --- the datastore and its proposer (§4.1, §4.2)


@registry.ArtifactPart("datastore", by_task=True, needs_task=True, described_by=MANIFEST)
def artifact() -> type:
    from kerv_cli.methods.heisd.datastore import DatastoreArtifact

    return DatastoreArtifact


@dataclass
class RetrievalProposerSettings:
    """Draft the task's most similar stored chunks, merged into one tree (docs/methods.md §4.2)."""

    kind: str = "retrieval"
    neighbours: int = number(5, 1, MOST_TOKENS)  # number of stored chunks in the tree
    nodes: int = number(50, 1, MOST_TOKENS)  # maximum number of tree nodes


@registry.ProposerPart(
    "retrieval",
    RetrievalProposerSettings,
    needs=("datastore",),
    colour=0x009E73,
    when=registry.PREFILL,
    chains=True,
    drafts_whole_chunk=True,
    looks_up=True,
    cost="retrieval",
    measured_by="retrieval_unverified",
    any_code=True,
)
class RetrievalProposer(ChainProposer):
    """Drafts the stored chunks of the most similar observations of the task, as one tree (docs/methods.md §4.2)."""

    name = "retrieval"

    def __init__(self, settings: RetrievalProposerSettings | HybridProposerSettings, context: Context) -> None:
        self.datastore: Datastore = context.artifact("datastore")
        self.target, self.count, self.nodes = context.target, settings.neighbours, settings.nodes
        self._nearest: tuple[Chunk, Neighbours] | None = None

    def neighbours(self, chunk: Chunk) -> Neighbours:
        """Return the stored entries most similar to the chunk's observation. The search runs once per chunk."""
        if self._nearest is None or self._nearest[0] is not chunk:
            key = self.datastore.key_of(chunk.target.prompt, self.target)
            self._nearest = chunk, self.datastore.query(key, chunk.episode.task, self.count)
            chunk.similarity = float(self._nearest[1].similarity[0])
        return self._nearest[1]

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        from kerv_cli.methods.heisd.datastore import neighbour_tree

        chunks = self.neighbours(chunk).chunks[:, : chunk.size]
        return neighbour_tree(chunks, len(chunk.tokens), chunk.space, self.nodes, depth)

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        start = len(chunk.tokens)
        return self.neighbours(chunk).chunks[:, start : min(chunk.size, start + depth)].tolist()


@dataclass
class HybridProposerSettings(DrafterProposerSettings):
    """HeiSD: draft by retrieval or with the drafter, as the boundary chooses (docs/methods.md §4.4).

    The defaults are smaller than for proposer=retrieval: on a CPU, a tree of 50 nodes costs more time than it saves.
    """

    kind: str = "hybrid"
    nodes: int = number(24, 1, MOST_TOKENS)  # maximum number of nodes of either tree
    neighbours: int = number(3, 1, MOST_TOKENS)  # retrieval: number of stored chunks in the tree


@registry.ProposerPart(
    "hybrid",
    HybridProposerSettings,
    needs=("drafter", "datastore"),
    when=registry.STATES,
    has_boundary=True,
    cost=registry.DRAFTING,
    idle=lambda settings: only_of_trees(settings, "top_k"),  # `nodes` also limits the tree of stored chunks
)
class HybridProposer(Proposer):
    """HeiSD: drafts by retrieval or with the drafter, as the boundary chooses for each chunk (docs/methods.md §4.4).

    `name` is the name of the proposer that drafts the current chunk.
    """

    def __init__(self, drafter: Proposer, retrieval: Proposer) -> None:
        self.proposers: dict[str, Proposer] = {"drafter": drafter, "retrieval": retrieval}
        self.nodes = max(drafter.nodes, retrieval.nodes)
        self.chosen, self.name = drafter, drafter.name

    @classmethod
    def build(cls, settings: HybridProposerSettings, context: Context) -> HybridProposer:
        drafter = registry.ProposerPart.find("drafter").built(settings, context)
        return cls(drafter, RetrievalProposer(settings, context))

    def begin(self, chunk: Chunk) -> None:
        assert chunk.choice is not None, "a hybrid proposer needs a boundary"
        self.chosen = self.proposers[chunk.choice.mode]
        self.name = self.chosen.name
        self.chosen.begin(chunk)

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        return self.chosen.propose(chunk, depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        self.chosen.committed(chunk, first, hidden, target_tokens)


# --- which drafts are good enough (§2.1)


@dataclass
class SequenceAcceptanceSettings:
    """HeiSD: accept or reject each kinematic group (position, rotation, gripper) of a control step as a whole.

    Strict DoFs, such as the gripper, must equal the target's tokens.
    """

    kind: str = "sequence"
    group_limit: int = number(30, 0, MOST_BINS)  # largest accepted sum of a group's distances, bins
    token_limit: int = number(15, 0, MOST_BINS)  # largest accepted distance of one token, bins


@registry.AcceptancePart("sequence", SequenceAcceptanceSettings, reads_threshold=False)
@dataclass(frozen=True)
class GroupRule(DistanceRule):
    """Accepts or rejects each kinematic group (position, rotation, gripper) of a control step as a whole.

    Strict DoFs, such as the gripper, must equal the target's tokens.
    """

    group_limit: int
    token_limit: int

    @classmethod
    def build(cls, settings: SequenceAcceptanceSettings, context: Context) -> GroupRule:
        return cls(context.target.actions, settings.group_limit, settings.token_limit)

    def limits(self, r: int) -> tuple[int, ...]:
        return self.same_limits(self.token_limit)

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        limits, bounds = self.limits(r), self.space.bounds
        return accept_by_group(tree, target_tokens, start, limits, group_limit=self.group_limit, bounds=bounds)


@dataclass
class HybridAcceptanceSettings(SequenceAcceptanceSettings):
    """HeiSD: judge retrieved drafts by acceptance=sequence, and all other drafts by acceptance=relaxed."""

    kind: str = "hybrid"
    strict_dofs: bool = True  # relaxed: whether strict DoFs, such as the gripper, must match (ours); public code: false


@registry.AcceptancePart("hybrid", HybridAcceptanceSettings)
@dataclass(frozen=True, kw_only=True)
class HybridRule(RelaxedRule):
    """Uses `GroupRule` for retrieved drafts, and `RelaxedRule` for all other drafts."""

    retrieved: GroupRule

    @classmethod
    def build(cls, settings: HybridAcceptanceSettings, context: Context) -> HybridRule:
        return cls(context.target.actions, settings.strict_dofs, retrieved=GroupRule.build(settings, context))

    def of_drafts_from(self, proposer: str) -> DistanceRule:
        return self.retrieved if proposer == "retrieval" else self


# --- who drafts for the hybrid proposer (§4.4)
#
# A boundary looks at the hand's last measured positions: R is their radius of curvature, D the length of their path. A
# straight, fast path (large R, large D) repeats demonstrated motion, so retrieval drafts. A curved or slow path is
# precise work, for which the drafter is better.


class Always(Boundary):
    """Makes the same choice for every chunk: boundary=always_retrieval or boundary=always_drafter."""

    def choose(self, path: np.ndarray) -> Choice:
        return Choice(self.settings.kind.removeprefix("always_"))


registry.BoundaryPart("always_retrieval", chooses=True)(Always)
registry.BoundaryPart("always_drafter", chooses=True)(Always)


@dataclass
class FusedBoundarySettings:
    """HeiSD: retrieval drafts if the hand moves straight and fast, the drafter if it moves in a curve or slowly.

    F is the weighted sum of the radius of curvature and the length of the hand's path, both scaled to [0, 1]. Retrieval
    drafts if F is at least the limit F*.
    """

    kind: str = "fused"
    alpha: float = number(0.5, 0, 1)  # weight of the radius of curvature; the path length has the weight 1 − alpha
    window: int = number(15, 3, MOST_DECODES)  # number of newest hand positions to look at
    quantile: float = number(0.25, 0, 1)  # the limit F* is this quantile of F in the demonstrations (public code: 0.25)
    f_star: float | None = number(None, 0, 1)  # the limit F* itself, in place of a quantile (ours)


@registry.BoundaryPart(
    "fused",
    FusedBoundarySettings,
    needs=("calibration",),
    chooses=True,
    idle=lambda settings: {} if settings.f_star is None else {"quantile": "boundary.f_star names the limit"},
)
class Fused(Boundary):
    """Chooses retrieval if F ≥ F* (see the settings), else the drafter. Before three hand positions: the drafter."""

    def __init__(self, settings: FusedBoundarySettings, context: Context) -> None:
        super().__init__(settings)
        self.ranges: BoundaryRanges = context.calibration.ranges(settings.window)
        limit = settings.f_star
        self.f_star = self.ranges.limit(settings.quantile, settings.alpha) if limit is None else limit

    def choose(self, path: np.ndarray) -> Choice:
        points = path[-self.settings.window :]
        if len(points) < LEAST:
            return Choice("drafter")
        metric = self.ranges.of_path(points, self.settings.alpha)
        return Choice("retrieval" if metric >= self.f_star else "drafter", metric)


# --- which retrieved chunks are executed without verification (§4.3)


@dataclass
class SimilaritySkipSettings:
    """HeiSD: execute the nearest stored chunk without verification if its observation is similar enough (s_min)."""

    kind: str = "similarity"
    s_min: float | None = number(None, -1e9, 1e9)  # smallest sufficient cosine; None: the task's calibrated value
    max_skips: int = number(2, 1, MOST_DECODES)  # maximum number of decodes in a row without verification (public code)
    # feedback, as a share of the calibrated range: s_min rises by `up` after a failed episode and falls by `down` after
    # a successful one; above 0, results depend on the order of the episodes
    up: float = number(0.0, 0, 1e9)
    down: float = number(0.0, 0, 1e9)

    def needs(self) -> tuple[str, ...]:
        return ("datastore", "calibration") if self.s_min is None else ("datastore",)


@registry.SkipPart("similarity", SimilaritySkipSettings, needs=SimilaritySkipSettings.needs, colour=0xF0E442)
class VerifySkip(Skip):
    """Executes the most similar stored chunk without verification if its similarity is at least s_min.

    At most `max_skips` chunks in a row are executed without verification. If the method has a boundary, the boundary
    must choose retrieval. Once the last chunk of a stored episode has been executed, no chunk of that stored episode
    is executed without verification in the rest of the robot's own episode.
    """

    def __init__(
        self, settings: SimilaritySkipSettings, retrieval: RetrievalProposer, levels: tuple[float, float, float]
    ) -> None:
        self.settings, self.retrieval = settings, retrieval
        self.low, self.s_min, self.high = levels
        self.in_a_row = 0
        self.ended: set[int] = set()  # seeds of stored episodes that were executed to their end

    @classmethod
    def build(cls, settings: SimilaritySkipSettings, context: Context) -> VerifySkip:
        proposer: Proposer | None = context.built["proposer"]
        retrieval = proposer.proposers["retrieval"] if isinstance(proposer, HybridProposer) else proposer
        if not isinstance(retrieval, RetrievalProposer):
            retrieval = RetrievalProposer(RetrievalProposerSettings(neighbours=1, nodes=1), context)
        if settings.s_min is not None:
            return cls(settings, retrieval, (settings.s_min,) * 3)
        manifest = retrieval.datastore.manifest
        return cls(settings, retrieval, context.calibration.skip_levels(context.task, manifest.content))

    def begin(self, task: str, seed: int) -> None:
        self.in_a_row = 0
        self.ended.clear()

    def finish(self, success: bool) -> None:
        span = self.high - self.low
        s_min = self.s_min + span * (-self.settings.down if success else self.settings.up)
        self.s_min = min(self.high, max(self.low, s_min))

    def take(self, chunk: Chunk) -> SkipDecision:
        if chunk.choice is not None and chunk.choice.mode != "retrieval":
            self.in_a_row = 0
            return SkipDecision()
        neighbours = self.retrieval.neighbours(chunk)
        seed = int(neighbours.seeds[0])
        if neighbours.similarity[0] < self.s_min or self.in_a_row >= self.settings.max_skips or seed in self.ended:
            self.in_a_row = 0
            return SkipDecision()
        self.in_a_row += 1
        if neighbours.left[0] <= chunk.steps:
            self.ended.add(seed)
        return SkipDecision(neighbours.chunks[0].tolist(), self.retrieval.name)
