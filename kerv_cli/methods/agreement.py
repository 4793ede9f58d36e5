"""Agreement of two views (docs/methods.md §4.8, ours): settings and registration, and the part, which needs nothing
heavy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.limits import number
from kerv_cli.base.registry import add, find
from kerv_cli.engine.parts import Skip
from kerv_cli.methods.watch import FARTHEST, check_source, is_near, needs_of_source

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.methods.context import Context


@dataclass
class AgreementSettings:
    """A draft is executed unverified where another source drafts nearly the same."""

    kind: str = "agreement"
    source: str = "early"  # the other view: a proposer that drafts whole chunks before the prefill
    tolerance: float = number(0.1, 0, FARTHEST)  # mean abs difference of two drafts that agree, normalised


class AgreementSkip(Skip):
    """Executes the in-prefill draft unverified where `other` drafts a chunk at most `tolerance` away, strict DoFs
    equal."""

    def __init__(self, draft: ChainProposer, other: ChainProposer, tolerance: float) -> None:
        self.draft, self.other, self.tolerance = draft, other, tolerance

    @classmethod
    def build(cls, settings: AgreementSettings, context: Context) -> AgreementSkip:
        """skip=agreement."""
        part = find("proposer", settings.source)
        other = part.built(part.default, context)
        return cls(context.built["prefill_draft"], other, settings.tolerance)

    def take(self, chunk: Chunk) -> bool:
        """Fills the chunk with the draft where both sources agree -> whether it did."""
        chains = [source.chains(chunk, chunk.size) for source in (self.draft, self.other)]
        if any(not chain or len(chain[0]) < chunk.size for chain in chains):
            return False
        (draft, *_), (other, *_) = chains
        if not is_near(chunk, draft, other, self.tolerance):
            return False
        chunk.skip(draft, self.draft.name)
        return True


_parts = ("kerv_cli.methods.agreement:AgreementSkip.build", AgreementSettings, needs_of_source, check_source)
add("skip", "agreement", *_parts, colour=0x4C9F70, takes_draft=True)
