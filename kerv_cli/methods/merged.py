"""Merge the drafts of several proposers into one tree (docs/methods.md §5, ours). `method=one_pass` uses it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, ProposerPart
from kerv_cli.engine.decisions import merge
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.methods.heisd import RetrievalProposerSettings

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.draft import Draft
    from kerv_cli.methods.context import Context


@dataclass
class MergedProposerSettings:
    """Merge the whole-chunk drafts of several proposers into one prefix tree (docs/methods.md §5, ours).

    The proposers in `fallback` draft only if no proposer in `sources` expects its whole chunk to be accepted. This
    keeps the tree small, because every node costs time.
    """

    kind: str = "merged"
    sources: list[str] = field(default_factory=lambda: ["early"])  # names of proposers that always draft
    fallback: list[str] = field(default_factory=lambda: ["hold"])  # names of proposers that draft if no source is sure
    nodes: int = number(48, 1, MOST_TOKENS)  # maximum number of tree nodes; the last drafts are dropped first
    neighbours: int = number(1, 1, MOST_TOKENS)  # if retrieval drafts: number of stored chunks

    def check_together(self, prefix: str) -> None:
        if not self.sources:
            raise UsageError("merged: name at least one of sources")
        for name in (*self.sources, *self.fallback):
            if not ProposerPart.find(name, "source of a merged draft").chains:
                raise UsageError(f"source '{name}' of a merged draft: it does not draft whole chunks from the prompt")


def needs_of_sources(settings: MergedProposerSettings) -> tuple[str, ...]:
    kinds: list[str] = []
    for name in (*settings.sources, *settings.fallback):
        part = ProposerPart.find(name)
        kinds += part.needed(part.default)
    return tuple(dict.fromkeys(kinds))


@ProposerPart(
    "merged", MergedProposerSettings, needs=needs_of_sources, colour=0xCC79A7, when=PREFILL, merged=True, cost="early"
)
class MergedProposer(ChainProposer):
    """Merges the drafts of several proposers into one prefix tree of at most `nodes` nodes.

    If the tree would be larger, the last drafts are left out. Proposers in `fallback` draft only if no source expects
    its whole chunk to be accepted.
    """

    def __init__(self, sources: Sequence[ChainProposer], nodes: int, fallback: Sequence[ChainProposer] = ()) -> None:
        together = [*sources, *fallback]
        names = [source.name for source in together]
        # records, and so prices, tell a merge with the early drafter's network from one without it
        self.name = "merged" if len(names) > 1 and "early" in names else "+".join(names)
        self.sources, self.fallback, self.nodes = sources, fallback, nodes

    @classmethod
    def build(cls, settings: MergedProposerSettings, context: Context) -> MergedProposer:
        def source(name: str) -> ChainProposer:
            part = ProposerPart.find(name)
            source_settings = part.default
            if isinstance(source_settings, RetrievalProposerSettings):
                source_settings = RetrievalProposerSettings(neighbours=settings.neighbours, nodes=settings.nodes)
            return part.built(source_settings, context)

        return cls([*map(source, settings.sources)], settings.nodes, [*map(source, settings.fallback)])

    def reset(self) -> None:
        for source in (*self.sources, *self.fallback):
            source.reset()

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        from kerv_cli.engine.draft import Draft

        chains = self.chains(chunk, depth)
        tree = merge(chains)
        while len(tree) > self.nodes:
            chains = chains[:-1] or [chains[0][: self.nodes]]
            tree = merge(chains)
        return Draft.of(tree.tokens, tree.parents)

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        sources = list(self.sources)
        if not any(source.is_sure(chunk) for source in sources):
            sources += self.fallback
        chains: list[list[int]] = []
        for source in sources:
            chains += source.chains(chunk, depth)
        return chains
