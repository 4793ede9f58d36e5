"""Example: a skip rule of your own: every second draft is executed without a verification."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.registry import NoSettings, add
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.methods.context import Context


class EverySecond(Skip):
    def __init__(self, source: ChainProposer) -> None:
        self.source, self.trusts = source, False

    def begin(self, task: str, seed: int) -> None:
        self.trusts = False

    def take(self, chunk: Chunk) -> bool:
        chains = self.source.chains(chunk, chunk.size)
        taken = self.trusts and bool(chains) and len(chains[0]) == chunk.size
        self.trusts = not self.trusts
        if taken:
            chunk.skip(chains[0], self.source.name)
        return taken


def build(settings: NoSettings, context: Context) -> EverySecond:
    return EverySecond(context.built["prefill_draft"])


add("skip", "every_second", f"{__name__}:build", takes_draft=True)  # refused without an in-prefill draft
