"""Proposers as the decode loop takes them: each turns what one room of `drafting/` knows into a token tree."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kerv_cli.decoding.chunk import Chunk
from kerv_cli.drafting.datastore import Datastore, Neighbours, neighbour_tree
from kerv_cli.drafting.drafter import Drafter, DraftState, grow_tree, observe
from kerv_cli.drafting.groups import kinematic_groups
from kerv_cli.drafting.tree import TokenTree, merge
from kerv_cli.settings import ProposerSettings
from kerv_cli.vla.action_tokens import VOCABULARY, bins_of
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

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, verdicts: Sequence[int]) -> None:
        pass


class RetrievalProposer:
    """The nearest stored chunks of the task, merged by kinematic group (METHODS §4.2)."""

    name = "retrieval"
    needs_states = False

    def __init__(self, datastore: Datastore, target: Target, neighbours: int, nodes: int) -> None:
        self.datastore, self.target, self.count, self.nodes = datastore, target, neighbours, nodes
        self.groups = kinematic_groups(target.settings.dofs)
        self._found: tuple[Chunk, Neighbours] | None = None

    def neighbours(self, chunk: Chunk) -> Neighbours:
        """Looked up once per chunk."""
        if self._found is None or self._found[0] is not chunk:
            key = self.datastore.key(chunk.prompt, self.target.settings)
            self._found = chunk, self.datastore.query(key, chunk.situation.task, self.count)
            chunk.similarity = float(self._found[1].similarity[0])
        return self._found[1]

    def begin(self, chunk: Chunk) -> None:
        pass

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        return neighbour_tree(self.neighbours(chunk).chunks, len(chunk.tokens), self.groups, self.nodes, depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, verdicts: Sequence[int]) -> None:
        pass


class MergedProposer:
    """Whole drafts of retrieval and of hold in one prefix tree: each neighbour's chunk is a branch, so is the hold."""

    name = "merged"
    needs_states = False

    def __init__(self, retrieval: RetrievalProposer, hold: HoldProposer, nodes: int) -> None:
        self.retrieval, self.hold, self.nodes = retrieval, hold, nodes

    def begin(self, chunk: Chunk) -> None:
        pass

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        start = len(chunk.tokens)
        chains = [row[start : start + depth] for row in self.retrieval.neighbours(chunk).chunks.tolist()]
        chains.append(list(self.hold.propose(chunk, depth).tokens))
        tree = merge(chains)
        while len(tree) > self.nodes and len(chains) > 1:  # the last neighbour goes first, hold stays
            del chains[-2]
            tree = merge(chains)
        return tree

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, verdicts: Sequence[int]) -> None:
        pass


class JacobiProposer:
    """PD-VLA's parallel decoding: guess all tokens, take the parallel argmax as the next guess, up to its fixed point.

    With strict acceptance the fixed point is AR's chunk. The first guess is the zero action.
    """

    name = "jacobi"
    needs_states = False

    def __init__(self) -> None:
        self.guess: list[int] = []

    def begin(self, chunk: Chunk) -> None:
        self.guess = [VOCABULARY // 2] * chunk.left

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        return TokenTree.chain(self.guess[:depth])

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, verdicts: Sequence[int]) -> None:
        accepted = len(chunk.tokens) - first - 2
        self.guess = list(verdicts[accepted + 1 :])


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
        observe(self.drafter, self.state, following, chunk.hidden, 0)

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        s = self.settings
        return grow_tree(self.drafter, self.target, self.state, min(s.depth, depth), s.top_k, s.nodes)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, verdicts: Sequence[int]) -> None:
        following = self.embed(chunk.tokens[first + 1 :])
        observe(self.drafter, self.state, following, hidden, self.target.prompt_length + first)

    def embed(self, tokens: list[int]) -> Tensor:
        """(1, T, E)."""
        return self.target.embedding(torch.tensor([tokens], device=self.target.device))
