"""Proposers: each makes token trees for the decode loop from one module of `drafting/`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from kerv_cli.engine.chunk import Asks, Chunk, DraftsChunks, Proposer
from kerv_cli.engine.protocol import ReadableTarget, Target
from kerv_cli.engine.transfer import read, upload
from kerv_cli.engine.tree import ROOT, TokenTree, merge
from kerv_cli.engine.unread import Placed, Unread
from kerv_cli.methods.datastore import Datastore, Neighbours, neighbour_tree
from kerv_cli.methods.eagle import DraftsStates, DraftState, draft_tree, observe
from kerv_cli.methods.early import EarlyDraft, EarlyDrafter
from kerv_cli.methods.kinematics import Predictor

EMPTY = TokenTree((), (), ())
SURE = 0.05
"""Estimate from which fallback sources do not draft: 89 % of such chunks were accepted whole (mt10-vision, r = 9)."""


class Stateless:
    """Base of proposers that need no hidden states and keep no state between rounds."""

    name = ""
    needs_states = False
    nodes = 0

    def begin(self, chunk: Chunk) -> None:
        """Nothing to prepare."""

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Nothing to remember."""

    def is_sure(self, chunk: Chunk) -> bool:
        """Never."""
        return False


class ChainProposer(Stateless):
    """A proposer whose draft is one chain of the chunk's remaining tokens."""

    def propose(self, chunk: Chunk, depth: int) -> TokenTree | Unread:
        """The first chain as a tree; empty where there is none."""
        chains = self.chains(chunk, depth)
        return TokenTree.chain(chains[0]) if chains else EMPTY

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """At most one chain of at most `depth` tokens."""
        raise NotImplementedError


class PredictionProposer(ChainProposer):
    """A kinematic prediction of the chunk (docs/methods.md §3.1, §6: `hold`, `kalman_only`). Committed steps of the
    chunk count as executed. Drafts nothing while the history is shorter than the predictor's minimum."""

    def __init__(self, predictor: Predictor) -> None:
        self.name, self.predictor = predictor.name, predictor

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """The predicted tokens of the chunk's remaining places; none while the history is too short."""
        whole = len(chunk.tokens) // chunk.dofs
        pending = np.array(chunk.tokens[: whole * chunk.dofs], dtype=np.int64).reshape(whole, chunk.dofs)
        history = chunk.situation.history.values(chunk.space.values_of(pending))
        predicted = self.predictor.predict(history, chunk.steps - whole)
        if predicted is None:
            return []
        tokens: list[int] = chunk.space.bins_of(predicted).flatten().tolist()
        return [tokens[len(chunk.tokens) - whole * chunk.dofs :][:depth]]


class EarlyProposer(ChainProposer):
    """The early drafter's chunk (docs/methods.md §5), drafted once per observation.

    waits: whether a draft is read before it is verified; otherwise with the target's tokens, which on a CPU gains
    nothing.
    """

    name = "early"

    def __init__(self, early: EarlyDrafter, target: ReadableTarget) -> None:
        self.early, self.target = early, target
        self.waits = target.device.type == "cpu"
        self._drafted: tuple[Chunk, EarlyDraft] | None = None

    def drafted(self, chunk: Chunk) -> EarlyDraft:
        """The draft of the chunk's N tokens."""
        if self._drafted is None or self._drafted[0] is not chunk:
            self._drafted = chunk, self.early.drafted(*self._inputs(chunk))
        return self._drafted[1]

    def _inputs(self, chunk: Chunk) -> tuple[Tensor, np.ndarray, int]:
        return self.target.pooled(chunk.prompt), chunk.situation.history.values(), max(chunk.limits, default=0)

    def unread(self, chunk: Chunk) -> Tensor | None:
        """The draft on the device, (N + 1,) as `EarlyDrafter.unread`; None where it was read. The reader calls
        `take`."""
        if self.waits or (self._drafted is not None and self._drafted[0] is chunk):
            return None
        numbers, self._logits = self.early.unread(*self._inputs(chunk))
        return numbers

    def take(self, chunk: Chunk, numbers: np.ndarray) -> None:
        """What `unread` gave, read."""
        self._drafted = chunk, EarlyDraft.of(numbers, self._logits)

    def propose(self, chunk: Chunk, depth: int) -> TokenTree | Unread:
        """The drafted chain."""
        numbers = self.unread(chunk)
        if numbers is None:
            return super().propose(chunk, depth)
        start = len(chunk.tokens)

        def placed(found: np.ndarray) -> Placed:
            self.take(chunk, found)
            tree = TokenTree.chain(self.chains(chunk, depth)[0])
            return tree, range(len(tree))

        return Unread(numbers[start : min(chunk.size, start + depth)].long(), numbers, placed)

    def distance(self, chunk: Chunk) -> float:
        """How far the observation is from those that the drafter was trained on; see `EarlyDrafter.distance`."""
        return self.early.distance(self.target.pooled(chunk.prompt))

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """The drafted tokens behind the committed ones."""
        return [self.drafted(chunk).tokens[len(chunk.tokens) : chunk.size][:depth]]

    def is_sure(self, chunk: Chunk) -> bool:
        """Whether the estimate that the whole chunk is accepted reaches SURE."""
        return self.drafted(chunk).odds >= SURE


class RetrievalProposer(Stateless):
    """The nearest stored chunks of the task, merged by kinematic group (docs/methods.md §4.2)."""

    name = "retrieval"

    def __init__(self, datastore: Datastore, target: ReadableTarget, neighbours: int, nodes: int) -> None:
        self.datastore, self.target, self.count, self.nodes = datastore, target, neighbours, nodes
        self.waits = target.device.type == "cpu"
        self._found: tuple[Chunk, Neighbours] | None = None

    def neighbours(self, chunk: Chunk) -> Neighbours:
        """The task's nearest entries to this observation; searched once per chunk. Sets `chunk.similarity`."""
        if self._found is None or self._found[0] is not chunk:
            self._search(chunk, read(self.datastore.pooled(chunk.prompt, self.target))[0])
        assert self._found is not None
        return self._found[1]

    def ask(self, chunk: Chunk) -> None:
        """As `Asks.ask`: the search key."""
        if not self.waits and (self._found is None or self._found[0] is not chunk):
            pooled = self.datastore.pooled(chunk.prompt, self.target)
            chunk.asked.append((pooled, lambda found: self._search(chunk, found)))

    def _search(self, chunk: Chunk, pooled: np.ndarray) -> None:
        key = self.datastore.key_of(pooled.astype(np.float32, copy=False))
        self._found = chunk, self.datastore.query(key, chunk.situation.task, self.count)
        chunk.similarity = float(self._found[1].similarity[0])

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        """The neighbours' chunks as one tree, merged by kinematic group."""
        chunks = self.neighbours(chunk).chunks[:, : chunk.size]
        return neighbour_tree(chunks, len(chunk.tokens), chunk.space, self.nodes, depth)

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Each neighbour's remaining tokens as a chain of its own, best neighbour first."""
        start = len(chunk.tokens)
        found: list[list[int]] = self.neighbours(chunk).chunks[:, start : min(chunk.size, start + depth)].tolist()
        return found


class MergedProposer(Stateless):
    """Merges the chains of several sources into one prefix tree (docs/methods.md §5). At most `nodes` nodes: the last
    chains are dropped first.

    fallback: sources that draft only where none of the others is sure of its chunk, because every node costs time.
    """

    def __init__(self, sources: Sequence[DraftsChunks], nodes: int, fallback: Sequence[DraftsChunks] = ()) -> None:
        every = [*sources, *fallback]
        self.name = every[0].name if len(every) == 1 else "merged"
        self.sources, self.fallback, self.nodes = sources, fallback, nodes

    def propose(self, chunk: Chunk, depth: int) -> TokenTree | Unread:
        """One prefix tree of all sources' chains; fallback sources join where none of the others is sure."""
        return self._unread(chunk, depth) or self._tree(chunk, depth)

    def _tree(self, chunk: Chunk, depth: int) -> TokenTree:
        sources = list(self.sources)
        if not any(source.is_sure(chunk) for source in sources):
            sources += self.fallback
        chains = [chain for source in sources for chain in source.chains(chunk, depth)]
        tree = merge(chains)
        while len(tree) > self.nodes:
            if len(chains) == 1:
                return TokenTree.chain(chains[0][: self.nodes])
            del chains[-1]
            tree = merge(chains)
        return tree

    def _unread(self, chunk: Chunk, depth: int) -> Unread | None:
        """An early draft that was not read, and all other chains beside it, whether they will be wanted or not: which
        of them are nodes of the tree is known once the draft is read. None where there is none, or no room."""
        early = next((source for source in self.sources if isinstance(source, EarlyProposer)), None)
        if early is None or (numbers := early.unread(chunk)) is None:
            return None
        start, device = len(chunk.tokens), numbers.device
        own = numbers[start : min(chunk.size, start + depth)].long()
        others = [s for s in (*self.sources, *self.fallback) if s is not early]
        beside = [chain for source in others for chain in source.chains(chunk, depth) if chain]
        lengths = [own.shape[0], *(len(chain) for chain in beside)]

        def placed(found: np.ndarray) -> Placed:
            early.take(chunk, found)
            tree = self._tree(chunk, depth)
            return tree, rows_of(tree, [early.chains(chunk, depth)[0], *beside])

        if sum(lengths) > max(self.nodes, chunk.size):
            early.take(chunk, read(numbers)[0])
            return None
        if not beside:
            return Unread(own, numbers, placed)
        depths = np.concatenate([np.arange(length) for length in lengths])
        chain_of = np.repeat(np.arange(len(lengths)), lengths)
        visible = (chain_of[:, None] == chain_of) & (depths[:, None] >= depths)
        tokens = torch.cat([own, upload([token for chain in beside for token in chain], device)])
        return Unread(tokens, numbers, placed, upload(visible, device), upload(depths, device))


def rows_of(tree: TokenTree, chains: Sequence[Sequence[int]]) -> list[int]:
    """The rows of a merged tree's nodes where its chains were forwarded one behind the other, unmerged."""
    children = {(parent, token): i for i, (parent, token) in enumerate(zip(tree.parents, tree.tokens, strict=True))}
    rows, first = [0] * len(tree), 0
    for chain in reversed(chains):
        first -= len(chain)
        node: int | None = ROOT
        for place, token in enumerate(chain):
            node = children.get((ROOT if node is None else node, token))
            if node is None:
                break
            rows[node] = first + place
    total = sum(len(chain) for chain in chains)
    return [total + row for row in rows]


class HybridProposer:
    """HeiSD: retrieval on one side of the boundary, the drafter on the other (docs/methods.md §4.4)."""

    needs_states = True

    def __init__(self, drafter: Proposer, retrieval: Proposer) -> None:
        self.sides: dict[str, Proposer] = {"drafter": drafter, "retrieval": retrieval}
        self.nodes = max(drafter.nodes, retrieval.nodes)
        self.chosen = drafter

    @property
    def name(self) -> str:
        """Name of the side that drafts this chunk."""
        return self.chosen.name

    def begin(self, chunk: Chunk) -> None:
        """Takes the side that the boundary chose for this chunk."""
        assert chunk.choice is not None, "a hybrid proposer needs a boundary"
        self.chosen = self.sides[chunk.choice.mode]
        self.chosen.begin(chunk)

    def ask(self, chunk: Chunk) -> None:
        """As `Asks.ask`: what the side that the boundary chose asks."""
        side = self.sides[chunk.choice.mode] if chunk.choice is not None else None
        if isinstance(side, Asks):
            side.ask(chunk)

    def propose(self, chunk: Chunk, depth: int) -> TokenTree | Unread:
        """The chosen side's tree."""
        return self.chosen.propose(chunk, depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Tells the chosen side."""
        self.chosen.committed(chunk, first, hidden, target_tokens)


class JacobiProposer:
    """PD-VLA's parallel decoding: guess all tokens, take the parallel argmax as the next guess, up to its fixed point.

    With strict acceptance the fixed point is AR's chunk. The first guess is the target tokens that the in-prefill
    draft's verification gave behind its rejection, then zero actions. `depth`: tokens guessed at once; 0: all.
    """

    name = "jacobi"
    needs_states = False
    nodes = 0

    def __init__(self, depth: int = 0) -> None:
        self.depth = depth
        self.guess: list[int] = []

    def begin(self, chunk: Chunk) -> None:
        """Makes the first guess."""
        known = chunk.rejection.target[: chunk.left]
        self.guess = [*known, *[chunk.space.tokens // 2] * (chunk.left - len(known))]

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        """The present guess as a chain."""
        return TokenTree.chain(self.guess[: min(depth, self.depth or depth)])

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """The next guess: this round's target tokens behind the committed ones, then the old guess."""
        accepted = len(chunk.tokens) - first - 2
        self.guess = [*target_tokens[accepted + 1 :], *self.guess[len(target_tokens) - 1 :]]


class DrafterProposer:
    """EAGLE-style drafter with a dynamic tree (docs/methods.md §2.2)."""

    name = "drafter"
    needs_states = True

    def __init__(self, drafter: DraftsStates, target: Target, depth: int, top_k: int, nodes: int) -> None:
        """depth: tokens; top_k: children expanded per level; nodes: kept after reranking."""
        self.drafter, self.target = drafter, target
        self.depth, self.top_k, self.nodes = depth, top_k, nodes
        capacity = target.max_prompt + target.chunk * target.actions.dofs + top_k * depth
        self.state = DraftState(drafter.new_cache(1, capacity), torch.empty(0))

    def begin(self, chunk: Chunk) -> None:
        """Feeds the drafter the prompt's states and embeddings."""
        following = torch.cat([chunk.prompt[:, 1:], self.embed(chunk.tokens)], 1)
        observe(self.drafter, self.state, following, chunk.hidden, 0)

    def propose(self, chunk: Chunk, depth: int) -> TokenTree | Unread:
        """A chain or dynamic tree of the settings' size."""
        return draft_tree(self.drafter, self.target, self.state, min(self.depth, depth), self.top_k, self.nodes)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Feeds the drafter the states of the newly committed positions."""
        following = self.embed(chunk.tokens[first + 1 :])
        observe(self.drafter, self.state, following, hidden, chunk.prompt_length + first)

    def embed(self, tokens: list[int]) -> Tensor:
        """T tokens -> the target's embeddings (1, T, E)."""
        return self.target.embed(upload([tokens], self.target.device))
