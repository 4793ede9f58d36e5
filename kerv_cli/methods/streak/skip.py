"""Executes drafts unverified for as long as verification keeps agreeing (docs/methods.md §4.5)."""

from __future__ import annotations

from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.loss import chunk_loss, judged_tokens
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.record import STREAK, TRUSTED
from kerv_cli.methods.context import Context
from kerv_cli.methods.merged.proposer import first_source
from kerv_cli.methods.streak import StreakSkipSettings


class StreakSkip(Skip):
    """Executes drafts unverified for as long as verification keeps agreeing (§4.5): a chunk whose draft agrees with the
    target's tokens allows one unverified decode before the next verification, the next one in a row two, then four, up
    to `most`; a chunk that does not agree ends it. An episode begins with a verification, or with `opening` unverified
    decodes."""

    def __init__(self, settings: StreakSkipSettings, source: ChainProposer) -> None:
        self.settings, self.source = settings, source
        self.allowed = 0  # unverified decodes after the last verification
        self.left = 0  # of these, how many are still to come
        self.chain: tuple[int, ...] = ()  # the source's draft of this chunk

    @classmethod
    def build(cls, settings: StreakSkipSettings, context: Context) -> StreakSkip:
        """skip=streak."""
        return cls(settings, first_source(context.built["prefill_draft"]))

    def begin(self, task: str, seed: int) -> None:
        """An episode begins."""
        self.allowed = self.left = self.settings.opening

    def take(self, chunk: Chunk) -> bool:
        """Fills the chunk with the source's draft while unverified decodes are left -> whether it did."""
        chains = self.source.chains(chunk, chunk.size)
        self.chain = tuple(chains[0]) if chains else ()
        trusted = self.left > 0 and len(self.chain) == chunk.size
        chunk.reason = TRUSTED if trusted else STREAK
        if not trusted:
            return False
        self.left -= 1
        chunk.skip(self.chain, self.source.name)
        return True

    def verified(self, chunk: Chunk) -> None:
        """The prefill verified the chunk: allows twice as many unverified decodes, or none."""
        self.allowed = min(self.settings.most, 2 * self.allowed or 1) if self._agrees(chunk) else 0
        self.left = self.allowed

    def _agrees(self, chunk: Chunk) -> bool:
        """Whether the source's draft was judged, and was accepted whole or is at most `tolerance` from the target's
        tokens on its own path, strict DoFs equal."""
        targets = judged_tokens(chunk, self.chain)
        if targets is None:
            return False
        if chunk.rounds[-1].accepted == len(chunk.rounds[-1].drafted):
            return True
        scale = self.settings.tolerance
        return scale > 0 and chunk_loss(chunk.space, self.chain[: len(targets)], targets, 2 * scale) <= 0.5
