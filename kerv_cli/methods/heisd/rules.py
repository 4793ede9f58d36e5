"""HeiSD's hybrid proposer, acceptance rules and verify-skip (docs/methods.md §2.1, §4.3, §4.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from kerv_cli.base.errors import UsageError
from kerv_cli.engine.acceptance import Acceptance, Accepted, Strict, accept_by_group
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.draft import Draft, TokenTree
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.context import Context
from kerv_cli.methods.eagle.drafter import DrafterProposer
from kerv_cli.methods.heisd import (
    HybridAcceptanceSettings,
    HybridProposerSettings,
    SequenceAcceptanceSettings,
    SimilaritySkipSettings,
)
from kerv_cli.methods.retrieval.datastore import RetrievalProposer
from kerv_cli.methods.spec_vla.rules import Relaxed


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
