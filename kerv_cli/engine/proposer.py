"""What drafts: the base of proposers, and that of those that draft a chain of the host's tokens (docs/extending.md).
Nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.draft import Draft


class Proposer:
    """Drafts a tree behind the committed tokens.

    name: in the record, e.g. `drafter`. needs_states: whether it reads the target's hidden states, so that it cannot
    draft before the prefill. nodes: most rows of its drafts, for which the cache has room; 0: as many as the chunk has
    tokens.
    """

    name = ""
    needs_states = False
    nodes = 0

    def reset(self) -> None:
        """A new episode begins."""

    def prepare(self, chunk: Chunk) -> None:
        """Called before the prefill; adds the vectors that it needs on the host to `chunk.reads`."""

    def begin(self, chunk: Chunk) -> None:
        """Called once per chunk, when the prompt is encoded and the first tokens are committed."""

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """A draft of at most `depth` levels; an empty one where it has none."""
        raise NotImplementedError

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Tokens were committed behind chunk index `first`, the last token before them; hidden (1, T, E) are the
        target's states at chunk indices first … first + T − 1. target_tokens: the round's 1 + n argmax tokens, those
        behind rejected nodes included."""


class ChainProposer(Proposer):
    """Drafts chains on the host. One that does so before the prefill (trait `chains`) is a source of merged drafts and
    of unverified chunks."""

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """The first chain; an empty draft where there is none."""
        from kerv_cli.engine.draft import EMPTY, Draft

        chains = self.chains(chunk, depth)
        return Draft.of(chains[0]) if chains else EMPTY

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Drafts of the tokens behind the committed ones, best first, at most `depth` tokens each; an empty list where
        it has no draft."""
        raise NotImplementedError

    def tokens_of(self, chunks: Sequence[Chunk]) -> list[list[int]]:
        """The first chains of B chunks of which nothing is committed, N tokens each."""
        return [self.chains(chunk, chunk.size)[0] for chunk in chunks]

    def is_sure(self, chunk: Chunk) -> bool:
        """Whether it expects its first chain to be accepted whole."""
        return False
