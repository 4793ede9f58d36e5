"""Skip rules that execute tokens without verification: the parallel pass, drafts, streaks.

parallel    all tokens of a chunk in one forward of the target, as in OpenVLA-OFT (docs/methods.md §6)
streak      drafts, as long as verified drafts agree with the target (§4.5, ours)
always      every draft (§6)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kerv_cli.base.limits import number
from kerv_cli.base.registry import NoSettings, SkipPart
from kerv_cli.engine.decisions import ROOT, SkipDecision
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.base.spaces import ActionSpace
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.decoder import Decoder
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.engine.protocol import ParallelTarget
    from kerv_cli.methods.context import Context

# values of `DecodeRecord.reason`; TRUSTED: the draft was executed without verification; STREAK: it was not, because no
# further decode without verification was allowed, or because the draft was incomplete
TRUSTED, STREAK = "trusted", "streak"


@SkipPart("parallel", colour=0x17BECF, verifies=False)
class ParallelPass(Skip):
    """Decodes all tokens of a chunk in one bidirectional forward of a parallel target. No token is verified."""

    phase = "prefill"

    def __init__(self, target: ParallelTarget) -> None:
        self.target = target

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> ParallelPass:
        return cls(context.target)

    def take(self, chunk: Chunk) -> SkipDecision:
        from kerv_cli.engine.record import PARALLEL

        hidden = self.target.parallel_pass(chunk.target.prompt, chunk.target.cache)
        return SkipDecision(self.target.head(hidden[0, : chunk.size]).argmax(-1).tolist(), PARALLEL)


def native_decoder(target: Any) -> Decoder:
    from kerv_cli.engine.decoder import Decoder, Parts

    return Decoder(target, Parts(skip=ParallelPass(target)) if getattr(target, "parallel", False) else None)


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
    """Executes drafts without verification, as long as verified drafts agree with the target (docs/methods.md §4.5).

    After the first verified chunk that agrees with its draft, the next decode is not verified. Each further agreement
    doubles the number of unverified decodes that follow, up to the setting `most`. A chunk that does not agree with its
    draft resets the number to 0. An episode starts with `opening` decodes without verification.

    Attributes:
        allowed: Number of unverified decodes that the last verification allowed.
        left: How many of the allowed decodes are still to come.
        chain: The draft of the current chunk.
    """

    def __init__(self, settings: StreakSkipSettings, context: Context) -> None:
        from kerv_cli.methods.merged import MergedProposer

        draft = context.built["prefill_draft"]
        self.settings = settings
        self.source: ChainProposer = draft.sources[0] if isinstance(draft, MergedProposer) else draft
        self.allowed = self.left = 0
        self.chain: tuple[int, ...] = ()

    def begin(self, task: str, seed: int) -> None:
        self.allowed = self.left = self.settings.opening

    def take(self, chunk: Chunk) -> SkipDecision:
        chains = self.source.chains(chunk, chunk.size)
        self.chain = tuple(chains[0]) if chains else ()
        if not self.left or len(self.chain) < chunk.size:
            return SkipDecision(reason=STREAK)
        self.left -= 1
        return SkipDecision(self.chain, self.source.name, TRUSTED)

    def verified(self, chunk: Chunk) -> None:
        targets, tolerance, agrees = targets_along(chunk, self.chain), self.settings.tolerance, False
        if targets is not None:
            # the draft leaves out the chunk's last token, such as a gripper, which is judged here
            accepted, last = chunk.rounds[0].drafted[: chunk.rounds[0].accepted], abs(self.chain[-1] - targets[-1])
            whole = accepted == self.chain[:-1] and last <= chunk.limits[-1]
            agrees = whole or (tolerance > 0 and distance(self.chain, targets, chunk.space) <= tolerance)
        self.allowed = self.left = min(self.settings.most, 2 * self.allowed or 1) if agrees else 0


def targets_along(chunk: Chunk, chain: Sequence[int]) -> list[int] | None:
    """Return the target's N predictions along a chain of N tokens, from the verification of the prefill draft.

    None if fewer than N − 1 tokens of this chain were verified.
    """
    tree, target_tokens, _ = chunk.judged
    nodes = {pair: node for node, pair in enumerate(zip(tree.parents, tree.tokens, strict=True))}
    node, targets = ROOT, list[int]()
    for token in chain:
        targets.append(target_tokens[node + 1])
        if (node, token) not in nodes:
            break
        node = nodes[node, token]
    return targets if len(targets) == chunk.size else None


def distance(tokens: Sequence[int], others: Sequence[int], space: ActionSpace) -> float:
    """Return the mean absolute difference of two chunks of tokens, normalised action units.

    The result is infinite if the chunks differ in a strict DoF, such as a gripper.
    """
    import numpy as np

    first, second = np.array(tokens), np.array(others)
    if (first != second)[space.strict_tokens(len(first))].any():
        return math.inf
    return float(np.abs(space.values_of(first) - space.values_of(second)).mean())


@SkipPart("always", takes_draft=True, verifies=False, any_code=True)
class AlwaysSkip(Skip):
    """Executes every draft without verification. If there is no draft of a whole chunk, the target decodes."""

    def __init__(self, source: ChainProposer) -> None:
        self.source = source

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> AlwaysSkip:
        return cls(context.built["prefill_draft"])

    def take(self, chunk: Chunk) -> SkipDecision:
        chains = self.source.chains(chunk, chunk.size)
        if not chains or len(chains[0]) < chunk.size:
            return SkipDecision()
        return SkipDecision(chains[0], self.source.name)
