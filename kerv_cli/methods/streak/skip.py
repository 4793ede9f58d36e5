"""Executes drafts unverified for as long as verification keeps agreeing (docs/methods.md §4.5)."""

from __future__ import annotations

import math

from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.loss import chunk_loss, judged_tokens
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import DraftsChunks
from kerv_cli.engine.record import STREAK, TRUSTED, Trust
from kerv_cli.methods.context import Context
from kerv_cli.methods.merged.proposer import first_source
from kerv_cli.methods.streak import StreakSkipSettings


class StreakSkip(Skip):
    """Executes drafts unverified for as long as verification keeps agreeing (§4.5): a chunk whose draft agrees with the
    target's tokens allows one unverified decode before the next verification, the next one in a row two, then four, up
    to `most`; a chunk that does not agree ends it. An episode begins with a verification."""

    def __init__(self, settings: StreakSkipSettings, source: DraftsChunks) -> None:
        self.settings, self.source = settings, source
        self.allowed = self.left = 0  # after the last verification, and of these still
        self.chain: tuple[int, ...] = ()  # the source's draft of this chunk

    @classmethod
    def build(cls, settings: StreakSkipSettings, context: Context) -> StreakSkip:
        """skip=streak."""
        return cls(settings, first_source(context.built["prefill_draft"]))

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
