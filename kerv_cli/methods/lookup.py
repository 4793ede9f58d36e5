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
    """Search the last chunk for the newest committed tokens, and draft the tokens that followed there."""

    kind: str = "lookup"
    longest: int = number(3, 1, MOST_TOKENS)  # number of newest tokens that are searched for; if not found, fewer


@ProposerPart("lookup", LookupProposerSettings, colour=0xB5651D, when=PREFILL, chains=True, any_code=True)
class LookupProposer(ChainProposer):
    """Searches the last chunk for the newest committed tokens, and drafts the tokens that followed there.

    The newest `longest` tokens are searched for, then fewer of them. If they occur several times, the occurrence
    nearest to the current index in the chunk wins. If not even the newest token occurs, or before the prefill, the
    draft is the last chunk's tokens from the current index on.
    """

    name = "lookup"

    def __init__(self, settings: Any, context: Any = None) -> None:
        self.longest = settings.longest

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return one chain of at most `depth` tokens. The chain is empty in an episode's first chunk."""
        last, tokens = chunk.situation.last, chunk.tokens
        for size in range(min(self.longest, len(tokens)), 0, -1):
            places = [place for place in range(size, len(last)) if last[place - size : place] == tokens[-size:]]
            if places:
                nearest = min(places, key=lambda place: abs(place - len(tokens)))
                return [last[nearest:][:depth]]
        return [last[len(tokens) :][:depth]]
