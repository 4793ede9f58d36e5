"""Jacobi decoding, as in PD-VLA (docs/methods.md §6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import STATES, add
from kerv_cli.engine.proposer import ChainProposer

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.methods.context import Context


@dataclass
class JacobiProposerSettings:
    """PD-VLA: the next guess is the parallel argmax of the last one (§6)."""

    kind: str = "jacobi"
    depth: int = number(0, 0, MOST_TOKENS)  # tokens guessed at once; 0: all that are left


class JacobiProposer(ChainProposer):
    """Guesses all tokens and takes their parallel argmax as the next guess, up to the fixed point.

    With strict acceptance the fixed point is the chunk of AR. The first guess is the target tokens after a rejection in
    the in-prefill draft, then zero actions.

    Attributes:
        depth: Tokens guessed at once; 0 for all.
    """

    name = "jacobi"

    def __init__(self, depth: int = 0) -> None:
        self.depth = depth
        self.guess: list[int] = []

    @classmethod
    def build(cls, settings: JacobiProposerSettings, context: Context) -> JacobiProposer:
        """Build proposer=jacobi."""
        return cls(settings.depth)

    def begin(self, chunk: Chunk) -> None:
        """Make the first guess."""
        tokens = chunk.rejection.target[: chunk.remaining]
        self.guess = [*tokens, *[chunk.space.tokens // 2] * (chunk.remaining - len(tokens))]

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return the present guess."""
        return [self.guess[: min(depth, self.depth or depth)]]

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Make the next guess: this round's target tokens after the committed ones, then the old guess."""
        accepted = len(chunk.tokens) - first - 2
        self.guess = [*target_tokens[accepted + 1 :], *self.guess[len(target_tokens) - 1 :]]


# without the trait `chains`: its first guess is made after the prefill
_BUILD = "kerv_cli.methods.jacobi:JacobiProposer.build"
add("proposer", "jacobi", _BUILD, JacobiProposerSettings, colour=0x8A7FD4, when=STATES)
