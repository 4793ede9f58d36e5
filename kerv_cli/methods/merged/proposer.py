"""Merges drafts of several sources into one prefix tree (docs/methods.md §5)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch

from kerv_cli.base.registry import find
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.transfer import read, upload
from kerv_cli.engine.tree import ROOT, TokenTree, merge
from kerv_cli.methods.context import Context
from kerv_cli.methods.early.drafter import EarlyProposer
from kerv_cli.methods.heisd import RetrievalProposerSettings
from kerv_cli.methods.merged import MergedProposerSettings


class MergedProposer(ChainProposer):
    """Merges the chains of several sources into one prefix tree of at most `nodes` nodes.

    If there are too many, the last chains are dropped first. The fallback sources draft only if no other is sure of its
    chunk.
    """

    def __init__(self, sources: Sequence[ChainProposer], nodes: int, fallback: Sequence[ChainProposer] = ()) -> None:
        together = [*sources, *fallback]
        self.name = together[0].name if len(together) == 1 else "merged"
        self.sources, self.fallback, self.nodes = sources, fallback, nodes

    @classmethod
    def build(cls, settings: MergedProposerSettings, context: Context) -> MergedProposer:
        """Build proposer=merged."""

        def source(name: str) -> ChainProposer:
            part = find("proposer", name)
            source_settings: Any = part.default
            if isinstance(source_settings, RetrievalProposerSettings):
                source_settings = RetrievalProposerSettings(neighbours=settings.neighbours, nodes=settings.nodes)
            return part.built(source_settings, context)

        sources, fallback = ([source(name) for name in names] for names in (settings.sources, settings.fallback))
        return cls(sources, settings.nodes, fallback)

    def reset(self) -> None:
        """Begin an episode."""
        for source in (*self.sources, *self.fallback):
            source.reset()

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """Return one prefix tree of all chains."""
        draft = self._on_device(chunk, depth)
        if draft is None:
            tree = self._tree(chunk, depth)
            draft = Draft.of(tree.tokens, tree.parents)
        return draft

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return the chains of the sources, and of the fallback sources if no source is sure."""
        sources = list(self.sources)
        if not any(source.is_sure(chunk) for source in sources):
            sources += self.fallback
        return [chain for source in sources for chain in source.chains(chunk, depth)]

    def _tree(self, chunk: Chunk, depth: int) -> TokenTree:
        chains = self.chains(chunk, depth)
        tree = merge(chains)
        while len(tree) > self.nodes:
            if len(chains) == 1:
                return TokenTree.build(chains[0][: self.nodes])
            del chains[-1]
            tree = merge(chains)
        return tree

    def _on_device(self, chunk: Chunk, depth: int) -> Draft | None:
        """Return the early draft on the GPU followed by the chains of all other sources.

        When the CPU has read the early draft, it decides which rows become nodes. None if the early draft is on the CPU
        or if the rows have no room.
        """
        early = next((source for source in self.sources if isinstance(source, EarlyProposer)), None)
        if early is None or (numbers := early.on_device(chunk)) is None:
            return None
        start = len(chunk.tokens)
        draft = numbers[start : min(chunk.size, start + depth)].long()
        others = [s for s in (*self.sources, *self.fallback) if s is not early]
        chains = [chain for source in others for chain in source.chains(chunk, depth) if chain]
        lengths = [draft.shape[0], *(len(chain) for chain in chains)]
        if sum(lengths) > max(self.nodes, chunk.size):
            early.receive(chunk, read(numbers)[0])
            return None

        def choose() -> tuple[TokenTree, list[int]]:
            tree = self._tree(chunk, depth)
            return tree, rows_of(tree, [early.chains(chunk, depth)[0], *chains])

        chunk.reads.append((numbers, partial(early.receive, chunk)))
        parents: list[int] = []
        for length in lengths:
            parents += [ROOT, *range(len(parents), len(parents) + length - 1)]
        if chains:
            draft = torch.cat([draft, upload([token for chain in chains for token in chain], draft.device)])
        return Draft(draft, torch.tensor(parents), choose=choose)


def rows_of(tree: TokenTree, chains: Sequence[Sequence[int]]) -> list[int]:
    """Return the row of each node of a merged tree whose chains were forwarded one after the other."""
    children = {(parent, token): i for i, (parent, token) in enumerate(zip(tree.parents, tree.tokens, strict=True))}
    rows, first = [0] * len(tree), 0
    for chain in reversed(chains):
        first -= len(chain)
        node: int | None = ROOT
        for index, token in enumerate(chain):
            node = children.get((ROOT if node is None else node, token))
            if node is None:
                break
            rows[node] = first + index
    total = sum(len(chain) for chain in chains)
    return [total + row for row in rows]
