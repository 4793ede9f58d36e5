"""Proposers as the decode loop takes them: each turns what one room of `drafting/` knows into a token tree."""

from __future__ import annotations

import torch
from torch import Tensor

from kerv_cli.decoding.chunk import Chunk
from kerv_cli.drafting.drafter import Drafter, DraftState, grow_tree, observe
from kerv_cli.drafting.tree import TokenTree
from kerv_cli.settings import ProposerSettings
from kerv_cli.vla.action_tokens import bins_of
from kerv_cli.vla.target import Target


class HoldProposer:
    """The last executed action, repeated. Nothing is drafted before there was one."""

    name = "hold"
    needs_states = False

    def begin(self, chunk: Chunk) -> None:
        pass

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        history = chunk.situation.history.values()
        if not len(history):
            return TokenTree((), (), ())
        held = bins_of(history[-1]).tolist()
        ahead = range(len(chunk.tokens), min(chunk.size, len(chunk.tokens) + depth))
        return TokenTree.chain([held[i % chunk.dofs] for i in ahead])

    def committed(self, chunk: Chunk, first: int, hidden: Tensor) -> None:
        pass


class DrafterProposer:
    """EAGLE-style drafter with a dynamic tree (METHODS §2.2)."""

    name = "drafter"
    needs_states = True

    def __init__(self, drafter: Drafter, target: Target, settings: ProposerSettings) -> None:
        self.drafter, self.target, self.settings = drafter, target, settings
        drafted = settings.top_k * max(1, settings.depth)
        capacity = target.prompt_length + target.tokens_per_chunk + drafted
        self.state = DraftState(drafter.new_cache(capacity), torch.empty(0))

    def begin(self, chunk: Chunk) -> None:
        following = torch.cat([chunk.prompt[:, 1:], self.embed(chunk.tokens)], 1)
        observe(self.drafter, self.target, self.state, following, chunk.hidden, 0)

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        s = self.settings
        return grow_tree(self.drafter, self.target, self.state, min(s.depth, depth), s.top_k, s.nodes)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor) -> None:
        following = self.embed(chunk.tokens[first + 1 :])
        observe(self.drafter, self.target, self.state, following, hidden, self.target.prompt_length + first)

    def embed(self, tokens: list[int]) -> Tensor:
        """(1, T, E)."""
        return self.target.embedding(torch.tensor([tokens], device=self.target.device))
