"""When a draft is executed without a verification (METHODS §4.3; HeiSD's verify-skip)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from kerv_cli.decoding.chunk import Chunk, DraftsChunks
from kerv_cli.decoding.proposers import RetrievalProposer
from kerv_cli.errors import UsageError
from kerv_cli.parts import SimilaritySkipSettings


@dataclass(frozen=True)
class SkipLevels:
    """The task's least similarity s_min, and the bounds that feedback moves it within; cosines."""

    low: float
    s_min: float
    high: float

    def __post_init__(self) -> None:
        if not self.low <= self.s_min <= self.high:
            raise UsageError(f"verify-skip: s_min {self.s_min} does not lie in {self.low}…{self.high}")


class Skip(Protocol):
    """Decides, before the target's trunk runs, whether a draft is executed as it is."""

    def reset(self) -> None:
        """A new episode begins."""

    def finish(self, success: bool) -> None:
        """An episode ended."""

    def take(self, chunk: Chunk) -> bool:
        """Complete the chunk with a draft's tokens, if it may be executed unverified."""


class AlwaysSkip:
    """Every draft is executed unverified: what a method costs and loses without verification (§6). Where the source has
    no whole chunk yet, the target decodes."""

    def __init__(self, source: DraftsChunks) -> None:
        self.source = source

    def reset(self) -> None:
        """Nothing is kept between decodes."""

    def finish(self, success: bool) -> None:
        """Nothing is kept between episodes."""

    def take(self, chunk: Chunk) -> bool:
        """As `Skip.take`."""
        chains = self.source.chains(chunk, chunk.size)
        if not chains or len(chains[0]) < chunk.size:
            return False
        chunk.skip(chains[0], self.source.name)
        return True


class VerifySkip:
    """Similarity of the best neighbour ≥ s_min: its chunk is the decode.

    At most `max_skips` decodes in a row; where a boundary decides, only on retrieval's side; and once a stored
    episode's end was reached, nothing more of that episode is executed unverified. With `up` or `down` above 0 s_min
    outlives the episode: it rises by `up` of the calibrated range after a failure and falls by `down` after a success,
    so that results depend on the order of episodes and on the evaluator's flag.
    """

    def __init__(self, settings: SimilaritySkipSettings, retrieval: RetrievalProposer, levels: SkipLevels) -> None:
        self.settings, self.retrieval, self.levels = settings, retrieval, levels
        self.s_min = levels.s_min
        self.in_a_row = 0
        self.ended: set[int] = set()  # seeds of stored episodes that were executed to their end

    def reset(self) -> None:
        """A new episode begins."""
        self.in_a_row = 0
        self.ended.clear()

    def finish(self, success: bool) -> None:
        """An episode ended."""
        span = self.levels.high - self.levels.low
        moved = self.s_min + span * (-self.settings.down if success else self.settings.up)
        self.s_min = min(self.levels.high, max(self.levels.low, moved))

    def take(self, chunk: Chunk) -> bool:
        """Complete the chunk with the best neighbour's tokens, if it may be executed unverified."""
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
