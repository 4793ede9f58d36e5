"""The EAGLE-style drafter, its dynamic tree, its proposer and its files (docs/methods.md §2.2; EAGLE-2; Spec-VLA §3).

Input at position i: concat(embedding of the token at i + 1, the target's last hidden state at i), mapped to the model's
width; the decoder layers predict the hidden state at i + 1, from which the target's frozen head gives the logits for
position i + 2. The prompt, vision tokens included, is in the drafter's cache. Rotary positions count from the prompt's
beginning, in training and at inference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.draft import HOST, Draft
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.protocol import ReadableTarget, Target
from kerv_cli.engine.transfer import upload
from kerv_cli.engine.tree import ROOT
from kerv_cli.methods.artifacts import Request, Weights, WeightsDescription
from kerv_cli.methods.context import Context
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.public import PublicDrafter, PublicShape, load_public
from kerv_cli.targets.attention import Cache
from kerv_cli.targets.compact.trunk import LayerStack


class Drafter(LayerStack):
    """One decoder layer (or a few) of the target's shape; the head and the token embeddings are the target's own."""

    def __init__(self, settings: DrafterSettings, width: int, heads: int, feed_forward: int) -> None:
        super().__init__(width, settings.layers, heads, feed_forward)
        self.settings = settings
        self.fuse = nn.Linear(2 * width, width)

    @classmethod
    def beside(cls, settings: DrafterSettings, target: ReadableTarget) -> Drafter:
        """A fresh drafter of the target's width, heads and feed-forward width."""
        return cls(settings, target.width, target.heads, target.feed_forward)

    def draft_position(self, index: int) -> int:
        """Rotary position of the drafted token at `index` of the sequence: `index` itself."""
        return index

    def forward(
        self,
        following: Tensor,
        hidden: Tensor,
        positions: Tensor,
        cache: Cache | None = None,
        seen: np.ndarray | Tensor | None = None,
    ) -> Tensor:
        """following, hidden (B, T, E) at positions (T,) -> predicted hidden states (B, T, E); seen (T, M) bool as in
        `attention_mask`."""
        x = self.fuse(torch.cat([following, hidden], -1))
        return self.norm(self.run_layers(x, positions, cache, seen))


class DrafterProposer(Proposer):
    """EAGLE-style drafter with a dynamic tree (docs/methods.md §2.2).

    cache: the drafter's, of every committed position but the last. hidden: (E,) predicted state from which the first
    draft token follows. Drafts stay on the device, nothing here waits for it.
    """

    name = "drafter"
    needs_states = True

    def __init__(self, drafter: Drafter | PublicDrafter, target: Target, depth: int, top_k: int, nodes: int) -> None:
        """depth: tokens; top_k: children expanded per level; nodes: kept after reranking."""
        self.drafter, self.target = drafter, target
        self.depth, self.top_k, self.nodes = depth, top_k, nodes
        capacity = target.max_prompt + target.chunk * target.actions.dofs + top_k * depth
        self.cache, self.hidden = drafter.new_cache(1, capacity), torch.empty(0)

    @classmethod
    def build(cls, settings: Any, context: Context) -> DrafterProposer:
        """proposer=drafter, and the drafter's side of hybrid: settings of either have depth, top_k and nodes."""
        return cls(context.artifact("drafter"), context.target, settings.depth, settings.top_k, settings.nodes)

    def begin(self, chunk: Chunk) -> None:
        """Feeds the drafter the prompt's states and embeddings."""
        self.observe(torch.cat([chunk.prompt[:, 1:], self.embed(chunk.tokens)], 1), chunk.hidden, 0)

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """A chain or dynamic tree of the settings' size."""
        depth = min(self.depth, depth)
        return Draft(self.chain(min(depth, self.nodes))) if self.top_k == 1 else self.tree(depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Feeds the drafter the states of the newly committed positions."""
        self.observe(self.embed(chunk.tokens[first + 1 :]), hidden, chunk.prompt_length + first)

    def embed(self, tokens: list[int]) -> Tensor:
        """T tokens -> the target's embeddings (1, T, E)."""
        return self.target.embed(upload([tokens], self.target.device))

    def observe(self, following: Tensor, hidden: Tensor, first: int) -> None:
        """Feeds the target's own states: hidden (1, T, E) at positions first, first + 1, … and the embedding of the
        token after each of them (1, T, E). Cache entries from `first` on (the last draft's) are overwritten."""
        self.cache.length = first
        positions = torch.arange(first, first + hidden.shape[1], device=hidden.device)
        self.hidden = self.drafter(following, hidden, positions, self.cache)[0, -1]

    def chain(self, depth: int) -> Tensor:
        """The greedy draft tokens (depth,), without the bookkeeping of a tree."""
        base = self.cache.length
        first = self.drafter.draft_position(base)
        positions = torch.arange(first, first + depth, device=self.hidden.device).split(1)
        hidden = self.hidden[None, None]
        drafted = [self.target.head(hidden[0]).argmax(-1)]
        for reached in range(depth - 1):
            following = self.target.embed(drafted[-1][None])
            hidden = self.drafter(following, hidden, positions[reached], self.cache)
            drafted.append(self.target.head(hidden[0]).argmax(-1))
        self.cache.length = base
        return torch.cat(drafted)

    def tree(self, depth: int) -> Draft:
        """EAGLE-2's dynamic tree: expand the top-k nodes of a level by cumulative log-probability, then keep the best
        of all. A child is never more probable than its parent, so the best nodes form a tree."""
        target, top_k, device = self.target, self.top_k, self.hidden.device
        scores = torch.log_softmax(target.head(self.hidden).float(), -1)
        values, tokens = scores.topk(min(top_k, self.nodes))
        width = tokens.shape[0]
        every, parents, cumulative = [tokens], [torch.full_like(tokens, ROOT)], [values]
        base, offset = self.cache.length, width
        first = self.drafter.draft_position(base)
        hidden = self.hidden.expand(1, width, -1)
        level = torch.arange(width, device=device)
        itself = torch.eye(max(width, top_k), dtype=torch.bool, device=device)
        seen = itself[:width, :width]  # of the nodes that were forwarded, level by level
        for reached in range(1, depth):
            following = target.embed(tokens[None])
            position = torch.full((width,), first + reached - 1, device=device)
            hidden = self.drafter(following, hidden, position, self.cache, seen.numpy() if device == HOST else seen)
            logp = torch.log_softmax(target.head(hidden[0]).float(), -1) + values[:, None]
            child_values, child_tokens = (best.flatten() for best in logp.topk(top_k, -1))
            values, flat = child_values.topk(top_k)
            # every child competes for a path in the tree, only the best top_k are expanded further
            parents.append(level[:, None].expand(-1, top_k).flatten())
            every.append(child_tokens)
            cumulative.append(child_values)
            level, offset, width = offset + flat, offset + child_tokens.shape[0], top_k
            tokens, rows = child_tokens[flat], flat // top_k
            hidden = hidden[:, rows]
            seen = torch.cat([seen[rows], itself[:top_k, :top_k]], 1)
        self.cache.length = base
        return _best(torch.cat(every), torch.cat(parents), torch.cat(cumulative), self.nodes, depth)


def _best(tokens: Tensor, parents: Tensor, scores: Tensor, nodes: int, depth: int) -> Draft:
    # the sort is stable and children stand behind their parents: on equal scores the parent is kept first
    best = scores.sort(descending=True, stable=True).indices[:nodes].sort().values
    index = torch.full((tokens.shape[0] + 1,), ROOT, device=tokens.device)  # its last entry is the root's
    index[best] = torch.arange(best.shape[0], device=tokens.device)
    return Draft(tokens[best], index[parents[best]], depth)


@dataclass(frozen=True, kw_only=True)
class DrafterDescription(WeightsDescription):
    """A drafter's JSON. public: shape and convention of one in the public layout."""

    settings: DrafterSettings
    public: PublicShape | None = None


class DrafterArtifact(Weights[DrafterDescription]):
    """The drafter's files; it drafts for a target with chunks of any length."""

    kind = noun = "drafter"
    command = ("train", "drafter")
    schema = DrafterDescription
    any_chunk = True

    def module(self, description: DrafterDescription, target: ReadableTarget) -> Drafter:
        """A fresh drafter."""
        return Drafter.beside(description.settings, target)

    def load(self, path: Path, request: Request) -> Drafter | PublicDrafter:
        """The drafter, ready for inference, of whichever layout."""
        public = self.checked(path, request.description).public
        if public is not None:
            return load_public(path, public, request.target)
        return super().load(path, request)
