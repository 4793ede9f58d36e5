"""Example: a proposer without weights. It drafts that the last executed action comes again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.registry import PREFILL, NoSettings, ProposerPart
from kerv_cli.engine.proposer import ChainProposer

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.methods.context import Context


@ProposerPart("repeat", NoSettings, when=PREFILL, chains=True)
class Repeat(ChainProposer):
    name = "repeat"

    def __init__(self, settings: NoSettings, context: Context) -> None: ...

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        executed = chunk.episode.history()  # (m, D) in [-1, 1]
        if not len(executed):
            return []
        tokens = chunk.space.bins_of(executed[-1]).tolist() * chunk.steps
        return [tokens[len(chunk.tokens) :][:depth]]
