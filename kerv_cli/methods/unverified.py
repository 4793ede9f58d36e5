"""Drafts that are never verified (docs/methods.md §6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from kerv_cli.base.registry import NoSettings, add
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.engine.protocol import Cache
    from kerv_cli.methods.context import Context


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


_BUILD = "kerv_cli.methods.unverified:AlwaysSkip.build"
add("skip", "always", _BUILD, takes_draft=True, verifies=False, batchable=True)
