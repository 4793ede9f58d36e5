"""Drafts from the last chunk's tokens: prompt lookup decoding (Saxena 2023; docs/methods.md §6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, ProposerPart
from kerv_cli.engine.proposer import ChainProposer

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk


@dataclass
class LookupProposerSettings:
    """Draft what followed in the last chunk after the newest tokens."""

    kind: str = "lookup"
    longest: int = number(3, 1, MOST_TOKENS)  # number of newest tokens that are searched for; if not found, fewer


@ProposerPart("lookup", LookupProposerSettings, colour=0xB5651D, when=PREFILL, chains=True, any_code=True)
class LookupProposer(ChainProposer):
    """Drafts the tokens that followed the newest committed tokens in the last chunk.

    It searches for the newest `longest` tokens, then for fewer. If not even the newest one occurs, or before the
    prefill, it drafts the last chunk's tokens from the same index on. Of several places, the one nearest to this index
    wins.
    """

    name = "lookup"

    def __init__(self, settings: Any, context: Any = None) -> None:
        self.longest = settings.longest

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return one chain of at most `depth` tokens. It is empty in an episode's first chunk."""
        last, tokens = chunk.situation.last, chunk.tokens
        for size in range(min(self.longest, len(tokens)), 0, -1):
            places = [place for place in range(size, len(last)) if last[place - size : place] == tokens[-size:]]
            if places:
                nearest = min(places, key=lambda place: abs(place - len(tokens)))
                return [last[nearest:][:depth]]
        return [last[len(tokens) :][:depth]]
