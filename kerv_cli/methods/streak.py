"""Execute drafts without verification: always (docs/methods.md §6), or while verified drafts agree (§4.5, ours)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.limits import number
from kerv_cli.base.registry import NoSettings, SkipPart
from kerv_cli.engine.decisions import SkipDecision
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.methods.context import Context

TRUSTED, STREAK = "trusted", "streak"
"""Values of `DecodeRecord.reason`. TRUSTED: the draft was executed without verification. STREAK: the target verified or
decoded the chunk, because no further decode without verification was allowed, or because the draft was incomplete."""


@dataclass
class StreakSkipSettings:
    """Execute 1, then 2, 4, … drafts without verification, as long as each verified chunk agrees with its draft (§4.5).

    The executed draft is the prefill draft. If the prefill draft merges the drafts of several proposers, only the draft
    of the first proposer is executed and compared.
    """

    kind: str = "streak"
    most: int = number(8, 1)  # maximum number of decodes in a row without verification
    opening: int = number(0, 0)  # number of decodes without verification when an episode begins
    # largest mean absolute difference of a draft that agrees, normalised action units; 0: it must be accepted whole
    tolerance: float = number(0.05, 0)


@SkipPart("streak", StreakSkipSettings, colour=0xE8C547, takes_draft=True, merges=True)
class StreakSkip(Skip):
    """Executes drafts without verification, as long as verified drafts agree with the target.

    After the first verified chunk that agrees with its draft, 1 decode is not verified. Each further agreement doubles
    this number, up to `most`. A chunk that does not agree resets it to 0. An episode begins with `opening` decodes
    without verification.

    Attributes:
        source: The proposer of the drafts.
        allowed: Number of unverified decodes that the last verification allowed.
        left: How many of the allowed decodes are still to come.
        chain: The draft of the current chunk.
    """

    def __init__(self, settings: StreakSkipSettings, source: ChainProposer) -> None:
        self.settings, self.source = settings, source
        self.allowed = 0
        self.left = 0
        self.chain: tuple[int, ...] = ()

    @classmethod
    def build(cls, settings: StreakSkipSettings, context: Context) -> StreakSkip:
        """Build the part that the setting `skip=streak` chooses."""
        from kerv_cli.methods.merged import MergedProposer

        draft = context.built["prefill_draft"]
        return cls(settings, draft.sources[0] if isinstance(draft, MergedProposer) else draft)

    def begin(self, task: str, seed: int) -> None:
        """Begin an episode. Its first decodes may go unverified, as many as the setting `opening` says."""
        self.allowed = self.left = self.settings.opening

    def take(self, chunk: Chunk) -> SkipDecision:
        """Take the draft, unverified, if one more such decode is allowed and the draft has all N tokens."""
        chains = self.source.chains(chunk, chunk.size)
        self.chain = tuple(chains[0]) if chains else ()
        if not self.left or len(self.chain) < chunk.size:
            return SkipDecision(reason=STREAK)
        self.left -= 1
        return SkipDecision(self.chain, self.source.name, TRUSTED)

    def verified(self, chunk: Chunk) -> None:
        """Double the number of decodes allowed without verification if the verified draft agrees; else set it to 0."""
        self.allowed = min(self.settings.most, 2 * self.allowed or 1) if self._agrees(chunk) else 0
        self.left = self.allowed

    def _agrees(self, chunk: Chunk) -> bool:
        """Return whether the draft was accepted whole, or differs from the target's tokens by at most `tolerance`.

        The difference is the mean absolute difference, in normalised action units. Tokens of strict DoFs, such as the
        gripper, must be equal. The result is False if the draft was not verified.
        """
        targets = chunk.targets_along(self.chain)
        if targets is None:
            return False
        if chunk.rounds[-1].accepted == len(chunk.rounds[-1].drafted):
            return True
        tolerance = self.settings.tolerance
        return tolerance > 0 and chunk.distance(self.chain[: len(targets)], targets) <= tolerance


@SkipPart("always", takes_draft=True, verifies=False, batchable=True, any_code=True)
class AlwaysSkip(Skip):
    """Executes every draft without verification. If there is no draft of a whole chunk, the target decodes."""

    def __init__(self, source: ChainProposer) -> None:
        self.source = source

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> AlwaysSkip:
        """Build the part that the setting `skip=always` chooses."""
        return cls(context.built["prefill_draft"])

    def take(self, chunk: Chunk) -> SkipDecision:
        """Take the draft, without verification, if it has all N tokens."""
        chains = self.source.chains(chunk, chunk.size)
        if not chains or len(chains[0]) < chunk.size:
            return SkipDecision()
        return SkipDecision(chains[0], self.source.name)
