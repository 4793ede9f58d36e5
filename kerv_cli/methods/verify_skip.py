"""When a draft is executed without a verification (docs/methods.md §4.3, §6)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.engine.chunk import Chunk, DraftsChunks
from kerv_cli.engine.loss import chunk_loss, judged_tokens
from kerv_cli.engine.protocol import ParallelTarget
from kerv_cli.engine.record import PARALLEL, STREAK, TRUSTED, Round, Trust
from kerv_cli.methods.parts import SimilaritySkipSettings, StreakSkipSettings
from kerv_cli.methods.proposers import RetrievalProposer


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


class Skip(ABC):
    """Decides, before the target verifies anything, whether a chunk is executed as it is. phase: of its time."""

    phase = "propose"

    def begin(self, task: str, seed: int) -> None:  # noqa: B027 - most rules keep nothing between decodes
        """A new episode begins."""

    def finish(self, success: bool) -> None:  # noqa: B027
        """An episode ended."""

    @abstractmethod
    def take(self, chunk: Chunk) -> bool:
        """Completes the chunk, if it may be executed unverified -> whether it did."""

    def verified(self, chunk: Chunk) -> None:  # noqa: B027
        """Told when the prefill of a chunk that was not taken has judged the in-prefill draft."""

    def completed(self, chunk: Chunk) -> None:  # noqa: B027
        """Told when a chunk that was not taken is complete."""


class ParallelPass(Skip):
    """Decodes all tokens by one bidirectional pass of a parallel target, as OpenVLA-OFT does (§6): each is chosen
    without knowing the others, and none is verified."""

    phase = "prefill"

    def __init__(self, target: ParallelTarget) -> None:
        self.target = target

    def take(self, chunk: Chunk) -> bool:
        """As `Skip.take`; always."""
        chunk.cache.length = 0
        hidden = self.target.parallel_pass(chunk.prompt, chunk.cache)
        tokens = self.target.head(hidden[0, : chunk.size]).argmax(-1).tolist()
        chunk.commit(Round(PARALLEL, "none", 0, (), tuple(tokens), 0, chunk.size, 0, ()), tokens)
        return True


class AlwaysSkip(Skip):
    """Executes every draft unverified: what a method costs and loses without verification (§6). Where the source has no
    whole chunk yet, the target decodes."""

    def __init__(self, source: DraftsChunks) -> None:
        self.source = source

    def take(self, chunk: Chunk) -> bool:
        """As `Skip.take`."""
        chains = self.source.chains(chunk, chunk.size)
        if not chains or len(chains[0]) < chunk.size:
            return False
        chunk.skip(chains[0], self.source.name)
        return True


class StreakSkip(Skip):
    """Executes drafts unverified for as long as verification keeps agreeing (§4.5): a chunk whose draft agrees with the
    target's tokens allows one unverified decode before the next verification, the next one in a row two, then four, up
    to `most`; a chunk that does not agree ends it. An episode begins with a verification."""

    def __init__(self, settings: StreakSkipSettings, source: DraftsChunks) -> None:
        self.settings, self.source = settings, source
        self.allowed = self.left = 0  # after the last verification, and of these still
        self.chain: tuple[int, ...] = ()  # the source's draft of this chunk

    def begin(self, task: str, seed: int) -> None:
        """As `Skip.begin`."""
        self.allowed = self.left = 0

    def take(self, chunk: Chunk) -> bool:
        """As `Skip.take`."""
        chains = self.source.chains(chunk, chunk.size)
        self.chain = tuple(chains[0]) if chains else ()
        taken = self.left > 0 and len(self.chain) == chunk.size
        chunk.trust = Trust(math.nan, math.nan, TRUSTED if taken else STREAK)
        if not taken:
            return False
        self.left -= 1
        chunk.skip(self.chain, self.source.name)
        return True

    def verified(self, chunk: Chunk) -> None:
        """As `Skip.verified`: doubles what is allowed, or ends it."""
        self.allowed = min(self.settings.most, 2 * self.allowed or 1) if self._agrees(chunk) else 0
        self.left = self.allowed

    def _agrees(self, chunk: Chunk) -> bool:
        """Whether the source's draft was judged, and was accepted whole or is at most `tolerance` from the target's
        tokens on its own path, strict DoFs equal."""
        wanted = judged_tokens(chunk, self.chain)
        if wanted is None:
            return False
        if chunk.rounds[-1].accepted == len(chunk.rounds[-1].drafted):
            return True
        scale = self.settings.tolerance
        return scale > 0 and chunk_loss(chunk.space, self.chain[: len(wanted)], wanted, 2 * scale) <= 0.5


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

    def begin(self, task: str, seed: int) -> None:
        """As `Skip.begin`."""
        self.in_a_row = 0
        self.ended.clear()

    def finish(self, success: bool) -> None:
        """An episode ended."""
        span = self.levels.high - self.levels.low
        moved = self.s_min + span * (-self.settings.down if success else self.settings.up)
        self.s_min = min(self.levels.high, max(self.levels.low, moved))

    def take(self, chunk: Chunk) -> bool:
        """Fills the chunk with the best neighbour's tokens if it may be executed unverified -> whether it did."""
        if chunk.choice is not None and chunk.choice.mode != "retrieval":
            self.in_a_row = 0
            return False
        found = self.retrieval.neighbours(chunk)
        seed = int(found.seeds[0])
        if found.similarity[0] < self.s_min or self.in_a_row >= self.settings.max_skips or seed in self.ended:
            self.in_a_row = 0
            return False
        self.in_a_row += 1
        if found.left[0] <= chunk.steps:
            self.ended.add(seed)
        chunk.skip(found.chunks[0].tolist(), self.retrieval.name)
        return True
