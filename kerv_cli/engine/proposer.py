"""What drafts: the protocols of proposers, and the bases of those that need little (docs/extending.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.tree import EMPTY, TokenTree
from kerv_cli.engine.unread import Unread


class DraftsChunks(Protocol):
    """A source of merged drafts: drafts whole chunks without the target's hidden states."""

    @property
    def name(self) -> str:
        """Its name in the record, e.g. `early`."""

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Drafts of the tokens behind the committed ones, best first, at most `depth` tokens each; an empty list where
        it has no draft."""

    def is_sure(self, chunk: Chunk) -> bool:
        """Whether it expects its first chain to be accepted whole."""


class Proposer(Protocol):
    """Drafts a tree behind the committed tokens."""

    @property
    def name(self) -> str:
        """Its name in the record, e.g. `drafter`."""

    @property
    def needs_states(self) -> bool:
        """Whether it reads the target's hidden states, so that it cannot draft before the prefill."""

    @property
    def nodes(self) -> int:
        """Most nodes of its trees, for which the cache has room; 0: as many as the chunk has tokens."""

    def begin(self, chunk: Chunk) -> None:
        """Called once per chunk, when the prompt is encoded and the first tokens are committed."""

    def propose(self, chunk: Chunk, depth: int) -> TokenTree | Unread:
        """A tree of depth ≤ `depth`; an empty one where it has no draft. One that lies on the device is read together
        with the target's tokens."""

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Tokens were committed behind chunk index `first`, the last token before them; hidden (1, T, E) are the
        target's states at chunk indices first … first + T − 1. target_tokens: the round's 1 + n argmax tokens, those
        behind rejected nodes included."""


@runtime_checkable
class Asks(Protocol):
    """A proposer that needs numbers of the encoded prompt on the host."""

    def ask(self, chunk: Chunk) -> None:
        """Called before the prefill: adds to `chunk.reads` the vectors to be read with its tokens."""


@runtime_checkable
class Remembers(Protocol):
    """A part that keeps something from one episode for the next."""

    def finish(self, success: bool) -> None:
        """An episode ended. One that another follows without it, as in a warm-up, is not to be remembered."""


class Stateless:
    """Base of proposers that need no hidden states and keep no state between rounds."""

    name = ""
    needs_states = False
    nodes = 0

    def begin(self, chunk: Chunk) -> None:
        """Nothing to prepare."""

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Nothing to remember."""

    def is_sure(self, chunk: Chunk) -> bool:
        """Never."""
        return False


class ChainProposer(Stateless):
    """A proposer whose draft is one chain of the chunk's remaining tokens."""

    def propose(self, chunk: Chunk, depth: int) -> TokenTree | Unread:
        """The first chain as a tree; empty where there is none."""
        chains = self.chains(chunk, depth)
        return TokenTree.chain(chains[0]) if chains else EMPTY

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """At most one chain of at most `depth` tokens."""
        raise NotImplementedError
