"""Example: a skip rule of your own: every second draft is executed without a verification."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.registry import SkipPart
from kerv_cli.engine.decisions import SkipDecision
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.methods.context import Context


@SkipPart("every_second", takes_draft=True)  # refused without an in-prefill draft
class EverySecond(Skip):
    def __init__(self, settings: object, context: Context) -> None:
        self.source: ChainProposer = context.built["prefill_draft"]
        self.trusts = False

    def begin(self, task: str, seed: int) -> None:
        self.trusts = False

    def take(self, chunk: Chunk) -> SkipDecision:
        chains = self.source.chains(chunk, chunk.size)
        self.trusts = not self.trusts
        if self.trusts or not chains or len(chains[0]) < chunk.size:
            return SkipDecision()  # the target decodes
        return SkipDecision(chains[0], self.source.name)
