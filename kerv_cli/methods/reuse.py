"""Proposers that reuse what is known: the target's last predictions (Jacobi), the last chunk or the last action.

docs/methods.md §5.2 and §6 describe them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, STATES, NoSettings, ProposerPart
from kerv_cli.engine.proposer import ChainProposer

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.engine.chunk import Chunk


@dataclass
class JacobiProposerSettings:
    """Jacobi decoding: guess all tokens, and take the target's argmax at all positions as the next guess (§6)."""

    kind: str = "jacobi"
    depth: int = number(0, 0, MOST_TOKENS)  # number of tokens guessed at once; 0: all remaining tokens


# without `chains`, because its first guess is made only after the prefill
@ProposerPart("jacobi", JacobiProposerSettings, colour=0x8A7FD4, when=STATES, any_code=True)
class JacobiProposer(ChainProposer):
    """Guesses the remaining tokens of a chunk. After each forward, the target's tokens become the next guess.

    With strict acceptance the result equals the tokens of autoregressive decoding. If a prefill draft was rejected, the
    first guess begins with the target's tokens after the rejection. All other tokens of the first guess are the end
    token, or the middle token (normalised action 0) if chunks have no end token.
    """

    name = "jacobi"
    guess: list[int]

    def begin(self, chunk: Chunk) -> None:
        judged = chunk.judged
        tokens = [judged.target_tokens[node + 1] for node in judged.rest][: chunk.remaining]
        filler = chunk.space.tokens // 2 if chunk.space.end is None else chunk.space.end
        self.guess = [*tokens, *[filler] * (chunk.remaining - len(tokens))]

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        return [self.guess[: min(depth, self.settings.depth or depth)]]

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        known = [*target_tokens, *self.guess[len(target_tokens) :]]  # of the places after token `first`
        self.guess = known[len(chunk.tokens) - first - 1 :]


@dataclass
class LookupProposerSettings:
    """Search the last chunk for the newest committed tokens, and draft the tokens that followed there."""

    kind: str = "lookup"
    longest: int = number(3, 1, MOST_TOKENS)  # number of newest tokens that are searched for; if not found, fewer


@ProposerPart("lookup", LookupProposerSettings, colour=0xB5651D, when=PREFILL, chains=True, any_code=True)
class LookupProposer(ChainProposer):
    """Searches the episode's earlier chunks for the newest committed tokens, and drafts the tokens that followed there.

    The newest chunk that has them wins. If it has them several times, the occurrence nearest to the current index in
    the chunk wins. If the newest `longest` tokens do not occur, fewer are searched for. If nothing is found, or no
    token is committed yet, the draft is the last chunk's tokens from the current index on.
    """

    name = "lookup"

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        earlier, tokens = chunk.episode.decoded, chunk.tokens
        for size in range(min(self.settings.longest, len(tokens)), 0, -1):
            for one in reversed(earlier):
                places = [place for place in range(size, len(one)) if one[place - size : place] == tokens[-size:]]
                if places:
                    nearest = min(places, key=lambda place: abs(place - len(tokens)))
                    return [one[nearest:][:depth]]
        return [earlier[-1][len(tokens) :][:depth]] if earlier else [[]]


@ProposerPart("last_action", NoSettings, colour=0x2CA25F, when=PREFILL, chains=True, any_code=True)
class LastActionProposer(ChainProposer):
    """Drafts the actions of the last chunk that are not executed yet, then repeats the last one of them (ours, §5.2).

    FAST tokens encode whole chunks, so these actions are encoded together.
    """

    name = "last_action"

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        import numpy as np

        space, episode = chunk.space, chunk.episode
        steps = space.code.steps if space.code else chunk.steps
        done = 0 if space.code else len(chunk.tokens) // space.dofs
        past = chunk.history()
        ahead = episode.planned[done:steps]
        if not ahead and not len(past):
            return []
        last = ahead[-1] if ahead else past[-1]
        actions = np.stack([*ahead, *[last] * (steps - done - len(ahead))])
        tokens: list[int] = space.normalised_tokens(actions[None])[0].tolist()
        return [tokens[len(chunk.tokens) - done * space.dofs :][:depth]]
