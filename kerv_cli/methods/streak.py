"""Drafts that are not verified: always (docs/methods.md §6), or while verifications agree with them (§4.5, ours)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.limits import number
from kerv_cli.base.registry import NoSettings, add
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.engine.protocol import Cache
    from kerv_cli.methods.context import Context

TRUSTED, STREAK = "trusted", "streak"
"""`DecodeRecord.reason`: executed unverified; verified because the verifications before do not allow more."""


@dataclass
class StreakSkipSettings:
    """Chunks that agree with their draft allow 1, 2, 4, … unverified decodes (§4.5).

    The draft is the in-prefill one; of `merged`, that of its first source.
    """

    kind: str = "streak"
    most: int = number(8, 1)  # decodes in a row without a verification
    opening: int = number(0, 0)  # decodes that an episode begins with, unverified
    tolerance: float = number(0.05, 0)  # mean abs difference that still agrees, normalised; 0: accepted whole


class StreakSkip(Skip):
    """Lets each verified chunk that agrees with its draft allow unverified decodes: 1, then 2, 4, … up to `most`.

    A chunk that does not agree ends this. An episode begins with `opening` unverified decodes.

    Attributes:
        allowed: Unverified decodes after the last verification.
        left: How many of these are still to come.
        chain: The source's draft of this chunk.
    """

    def __init__(self, settings: StreakSkipSettings, source: ChainProposer) -> None:
        self.settings, self.source = settings, source
        self.allowed = 0  # unverified decodes after the last verification
        self.left = 0  # of these, how many are still to come
        self.chain: tuple[int, ...] = ()  # the source's draft of this chunk

    @classmethod
    def build(cls, settings: StreakSkipSettings, context: Context) -> StreakSkip:
        """Build skip=streak."""
        draft = context.built["prefill_draft"]
        return cls(settings, getattr(draft, "sources", [draft])[0])  # of a merged draft its first source

    def begin(self, task: str, seed: int) -> None:
        """Begin an episode."""
        self.allowed = self.left = self.settings.opening

    def take(self, chunk: Chunk) -> bool:
        """Fill the chunk with the source's draft while unverified decodes are left -> whether it did."""
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
        """Allow twice as many unverified decodes if the verified chunk agrees with the draft, else none."""
        self.allowed = min(self.settings.most, 2 * self.allowed or 1) if self._agrees(chunk) else 0
        self.left = self.allowed

    def _agrees(self, chunk: Chunk) -> bool:
        """Return whether the draft was accepted whole or is on average within `tolerance` of the target's tokens.

        Strict DoFs must be equal.
        """
        targets = chunk.targets_along(self.chain)
        if targets is None:
            return False
        if chunk.rounds[-1].accepted == len(chunk.rounds[-1].drafted):
            return True
        tolerance = self.settings.tolerance
        return tolerance > 0 and chunk.distance(self.chain[: len(targets)], targets) <= tolerance


class AlwaysSkip(Skip):
    """Executes every draft unverified. If the source has no whole chunk yet, the target decodes."""

    def __init__(self, source: ChainProposer) -> None:
        self.source = source

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> AlwaysSkip:
        """Build skip=always."""
        return cls(context.built["prefill_draft"])

    def take(self, chunk: Chunk) -> bool:
        """Fill the chunk with the source's draft -> whether there was one of all N tokens."""
        chains = self.source.chains(chunk, chunk.size)
        if not chains or len(chains[0]) < chunk.size:
            return False
        chunk.skip(chains[0], self.source.name)
        return True

    def take_many(self, chunks: Sequence[Chunk], cache: Callable[[int], Cache]) -> None:
        """Fill several chunks with the source's drafts."""
        for chunk, tokens in zip(chunks, self.source.tokens_of(chunks), strict=True):
            chunk.skip(tokens, self.source.name)


_FILE = "kerv_cli.methods.streak:"
add("skip", "streak", _FILE + "StreakSkip.build", StreakSkipSettings, colour=0xE8C547, takes_draft=True, merges=True)
add("skip", "always", _FILE + "AlwaysSkip.build", takes_draft=True, verifies=False, batchable=True)
