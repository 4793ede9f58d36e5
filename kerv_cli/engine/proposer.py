"""Base classes of proposers (docs/extending.md). This file imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.draft import Draft


class Proposer:
    """Drafts a tree of the tokens after the committed ones.

    Attributes:
        name: Name in the record, e.g. `drafter`.
        needs_states: Whether it reads the target's hidden states. It then cannot draft before the prefill.
        nodes: Maximum number of rows in a draft, for which the cache has room; 0 for as many as the chunk has tokens.
    """

    name = ""
    needs_states = False
    nodes = 0

    def reset(self) -> None:
        """Begin an episode."""

    def prepare(self, chunk: Chunk) -> None:
        """Prepare for the prefill: add the vectors that the CPU needs to `chunk.reads`."""

    def begin(self, chunk: Chunk) -> None:
        """Begin a chunk, after its prefill has committed the first tokens."""

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return a draft of at most `depth` levels, or an empty one."""
        raise NotImplementedError

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Learn from a round.

        Args:
            chunk: The chunk, with the round's tokens committed.
            first: Chunk index of the last token that was committed before the round.
            hidden: The target's states (1, T, E) at chunk indices first … first + T − 1.
            target_tokens: The round's 1 + n target tokens, those after rejected nodes included.
        """


class ChainProposer(Proposer):
    """Drafts chains on the CPU. If it drafts before the prefill, it can be merged or executed unverified."""

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return the first chain, or an empty draft."""
        from kerv_cli.engine.draft import EMPTY, Draft

        chains = self.chains(chunk, depth)
        return Draft.of(chains[0]) if chains else EMPTY

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return drafts of the tokens after the committed ones, best first, of at most `depth` tokens each."""
        raise NotImplementedError

    def tokens_of(self, chunks: Sequence[Chunk]) -> list[list[int]]:
        """Return the first chains of B chunks of which nothing is committed, N tokens each."""
        return [self.chains(chunk, chunk.size)[0] for chunk in chunks]

    def is_sure(self, chunk: Chunk) -> bool:
        """Return whether it expects its first chain to be accepted whole."""
        return False
