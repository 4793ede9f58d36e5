"""The EAGLE-style drafter: network and dynamic tree (docs/methods.md §2.2; EAGLE-2; Spec-VLA §3).

The input at position i is the embedding of token i + 1, concatenated with the target's last hidden state at i. The
output is the hidden state at i + 1, from which the target's frozen head computes the logits of token i + 2. The
drafter's cache holds the whole prompt, and rotary positions count from the prompt's beginning.

Shapes: B sequences, T new tokens, P prompt tokens, N tokens of a chunk, E width of the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decisions import ROOT
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.draft import HOST, Draft, consecutive, upload
from kerv_cli.engine.parts import Fixed
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.protocol import JoinsDrafters, Seen, Target
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.spec_vla import RelaxedRule
from kerv_cli.targets.attention import Cache
from kerv_cli.targets.compact.program import Program
from kerv_cli.targets.compact.trunk import LayerStack


class EagleNetwork(LayerStack):
    """The drafter's network: decoder layers of the target's shape. It uses the target's embeddings and head."""

    inputs = 2

    def __init__(self, settings: DrafterSettings, width: int, heads: int, feed_forward: int) -> None:
        super().__init__(width, settings.layers, heads, feed_forward, settings.final_norm)
        self.settings = settings
        self.fuse = nn.Linear(2 * width, width)

    def enter(self, *inputs: Tensor) -> Tensor:
        return self.fuse(torch.cat(inputs, -1))

    def forward(
        self, following: Tensor, hidden: Tensor, positions: Tensor, cache: Cache | None = None, seen: Seen = None
    ) -> Tensor:
        """Return the predicted hidden states (B, T, E) at the next positions.

        Args:
            following: (B, T, E) embedding of the token after each position.
            hidden: (B, T, E) hidden states at the positions.
            positions: (T,) rotary positions.
            seen: Attention mask (T, M) bool over the last M tokens. If None, attention is causal.
        """
        return self.run((following, hidden), positions, cache, seen)

    def joined(self, target: Any, tree: bool) -> Any:
        """Return a compiled program that drafts level after level. None if drafter or target is not compiled."""

        def step(hidden: Any) -> Tensor:
            logits = target.head(hidden)
            token, parent = logits.branch(hidden) if tree else (logits.argmax(-1), hidden)
            return self.recorded(target.embedding(token)[None], parent)

        joins = isinstance(target, JoinsDrafters) and isinstance(self.compiled, Program)
        return target.join(step, (1, 1, self.outer), repeats=True) if joins else None


class DrafterProposer(Proposer):
    """Drafts a chain or a dynamic tree (docs/methods.md §2.2). The drafts stay on the GPU, so the CPU need not wait.

    Attributes:
        top_k: Number of nodes per depth that get children, and number of children of each. If 1, the draft is a chain.
        cache: Keys and values of the drafter, for all committed positions except the last.
        hidden: (E,) predicted hidden state. The target's head computes the first draft token from it.
    """

    name = "drafter"

    def __init__(self, drafter: EagleNetwork, target: Target, depth: int, top_k: int, nodes: int) -> None:
        self.drafter, self.target = drafter, target
        self.depth, self.top_k, self.nodes = depth, min(top_k, target.actions.tokens), nodes
        capacity = target.max_prompt + target.actions.longest(target.chunk) + top_k * depth
        self.cache, self.hidden = drafter.new_cache(1, capacity), torch.empty(0)
        self.compiled = drafter.joined(target, top_k > 1)

    def begin(self, chunk: Chunk) -> None:
        hidden = chunk.target.hidden
        assert hidden is not None, "the prefill comes first"
        self.observe(torch.cat([chunk.target.prompt[:, 1:], self.embed(chunk.tokens)], 1), hidden, 0)

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        depth = min(self.depth, depth)
        return Draft(self.chain(min(depth, self.nodes))) if self.top_k == 1 else self.tree(depth)

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        self.observe(self.embed(chunk.tokens[first + 1 :]), hidden, chunk.target.prompt_length + first)

    def embed(self, tokens: list[int]) -> Tensor:
        return self.target.embed(upload([tokens], self.target.device))

    def observe(self, following: Tensor, hidden: Tensor, first: int) -> None:
        self.cache.length = first
        positions = consecutive(first, first + hidden.shape[1], hidden.device)
        self.hidden = self.drafter(following, hidden, positions, self.cache)[0, -1]

    def chain(self, depth: int) -> Tensor:
        """Draft a chain greedily. Return its tokens, (depth,) int64."""
        base = self.cache.length
        if self.compiled is not None:
            return torch.from_numpy(self.compiled.repeat(depth, self.hidden, cache=self.cache)[:, 0]).long()
        positions = torch.arange(base, base + depth, device=self.hidden.device).split(1)
        hidden = self.hidden[None, None]
        drafted = [self.target.head(hidden[0]).argmax(-1)]
        for reached in range(depth - 1):
            following = self.target.embed(drafted[-1][None])
            hidden = self.drafter(following, hidden, positions[reached], self.cache)
            drafted.append(self.target.head(hidden[0]).argmax(-1))
        self.cache.length = base
        return torch.cat(drafted)

    def tree(self, depth: int) -> Draft:
        """Draft EAGLE-2's dynamic tree of at most `depth` tokens per path.

        At each depth, the `top_k` nodes with the highest cumulative log-probability get `top_k` children each. In the
        end the `nodes` most probable nodes are kept. They form a tree, because a child is never more probable than its
        parent.
        """
        target, top_k, device, base = self.target, self.top_k, self.hidden.device, self.cache.length
        if self.compiled is not None:
            root = self.hidden[None, None]
            grown = self.compiled.grow(depth, top_k, self.nodes, root, position=base, cache=self.cache)
            return Draft(torch.from_numpy(grown[0]), torch.from_numpy(grown[1]), depth, grown[2])
        values, tokens = _most(torch.log_softmax(target.head(self.hidden).float(), -1), top_k)
        every, parents, cumulative = [tokens], [torch.full_like(tokens, ROOT)], [values]
        hidden, offset = self.hidden.expand(1, top_k, -1), top_k
        level = torch.arange(top_k, device=device)
        seen = itself = torch.eye(top_k, dtype=torch.bool, device=device)  # draft nodes that each node of a level sees
        for reached in range(1, depth):
            following = target.embed(tokens[None])
            position = torch.full((top_k,), base + reached - 1, device=device)
            hidden = self.drafter(following, hidden, position, self.cache, seen.numpy() if device == HOST else seen)
            logp = torch.log_softmax(target.head(hidden[0]).float(), -1) + values[:, None]
            child_values, child_tokens = (best.flatten() for best in _most(logp, top_k))
            values, flat = _most(child_values, top_k)
            # all children may become nodes of the tree, but only the best top_k get children
            parents.append(level[:, None].expand(-1, top_k).flatten())
            every.append(child_tokens)
            cumulative.append(child_values)
            level, offset = offset + flat, offset + child_tokens.shape[0]
            tokens, rows = child_tokens[flat], flat // top_k
            hidden = hidden[:, rows]
            seen = torch.cat([seen[rows], itself], 1)
        self.cache.length = base
        # the sort is stable and children come after their parents, so at equal scores the parent is kept
        best = torch.cat(cumulative).sort(descending=True, stable=True).indices[: self.nodes].sort().values
        index = torch.full((offset + 1,), ROOT, device=device)  # the last entry is the root
        index[best] = torch.arange(best.shape[0], device=device)
        return Draft(torch.cat(every)[best], index[torch.cat(parents)[best]], depth)


def _most(scores: Tensor, count: int) -> tuple[Tensor, Tensor]:
    values, indices = scores.sort(dim=-1, descending=True, stable=True)
    return values[..., :count], indices[..., :count]


def acceptance_length(target: Target, network: EagleNetwork, prompts: list[Tensor], r: int) -> float:
    """Return the acceptance length: tokens committed per verification (docs/methods.md §7).

    Args:
        prompts: Encoded prompts to decode, each (1, P, E).
        r: Acceptance radius, in bins. Tokens of strict DoFs, such as the gripper, must equal the target's.
    """
    proposer = DrafterProposer(network, target, depth=5, top_k=1, nodes=5)
    decoder = Decoder(target, Parts(RelaxedRule(target.actions), Fixed(r), proposer=proposer))
    committed = rounds = 0
    for prompt in prompts:
        for one in decoder.decode_prompt(prompt).rounds:
            committed += one.committed * (one.tree_size > 0)
            rounds += one.tree_size > 0
    return committed / max(1, rounds)
