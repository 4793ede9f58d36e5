"""Guesses all tokens of a chunk at once, up to a fixed point (docs/methods.md §6)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.context import Context
from kerv_cli.methods.jacobi import JacobiProposerSettings


class JacobiProposer(Proposer):
    """PD-VLA's parallel decoding: guess all tokens, take the parallel argmax as the next guess, up to its fixed point.

    With strict acceptance the fixed point is AR's chunk. The first guess is the target tokens that the in-prefill
    draft's verification gave behind its rejection, then zero actions. `depth`: tokens guessed at once; 0: all.
    """

    name = "jacobi"

    def __init__(self, depth: int = 0) -> None:
        self.depth = depth
        self.guess: list[int] = []

    @classmethod
    def build(cls, settings: JacobiProposerSettings, context: Context) -> JacobiProposer:
        """proposer=jacobi."""
        return cls(settings.depth)

    def begin(self, chunk: Chunk) -> None:
        """Makes the first guess."""
        tokens = chunk.rejection.target[: chunk.remaining]
        self.guess = [*tokens, *[chunk.space.tokens // 2] * (chunk.remaining - len(tokens))]

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """The present guess as a chain."""
        return Draft.of(self.guess[: min(depth, self.depth or depth)])

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """The next guess: this round's target tokens behind the committed ones, then the old guess."""
        accepted = len(chunk.tokens) - first - 2
        self.guess = [*target_tokens[accepted + 1 :], *self.guess[len(target_tokens) - 1 :]]
