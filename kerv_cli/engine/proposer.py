"""Base classes of proposers (docs/extending.md). This file imports neither torch nor numpy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

from kerv_cli.engine.parts import Buildable

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.draft import Draft


class Proposer(Buildable):
    """Base class of proposers. A proposer drafts a tree of tokens that continue the committed tokens.

    Attributes:
        name: Name in the records, e.g. `drafter`.
        nodes: Maximum number of tokens of a draft, for which the target's cache reserves room. It may stay 0 if a
            draft never has more tokens than a chunk.
    """

    name = ""
    nodes = 0

    def reset(self) -> None:
        """Start a new episode."""

    def begin(self, chunk: Chunk) -> None:
        """Begin a chunk. Called after its prefill has committed the first tokens."""

    @abstractmethod
    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return a draft with at most `depth` tokens on any path. The draft may be empty."""

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Learn from a round that has ended.

        Args:
            chunk: The chunk, which already holds the round's committed tokens.
            first: Index in the chunk of the token just before this round's tokens. `hidden` starts with this token.
            hidden: The target's hidden states (1, T, E) of T tokens of the chunk, with indices first … first + T − 1.
            target_tokens: 1 + n tokens: the target's prediction after token `first`, then after each of the draft's n
                nodes. Rejected nodes are included.
        """


class ChainProposer(Proposer):
    """Base class of proposers that draft plain sequences (chains) on the CPU.

    Chains that are drafted before the prefill can be merged with other proposers' chains, or executed without
    verification.
    """

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        from kerv_cli.engine.draft import EMPTY, Draft

        chains = self.chains(chunk, depth)
        return Draft.of(chunk.until_end(chains[0])) if chains else EMPTY

    @abstractmethod
    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return token sequences that continue the committed tokens, best first, at most `depth` tokens each."""

    def is_sure(self, chunk: Chunk) -> bool:
        """Return whether the proposer expects all tokens of its best chain to be accepted. False in this base class."""
        return False
