"""Drafts as trees, and what the parts of a method return to the decoder. Imports neither torch nor numpy.

After c committed tokens, a node at depth d is token c + d of the chunk (docs/methods.md §2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np


ROOT = -1


@dataclass(frozen=True)
class TokenTree:
    """A draft as a tree of n nodes, on the CPU.

    Attributes:
        tokens: Token of each node.
        parents: Index of each node's parent, smaller than the node's index; −1 is the last committed token.
        depths: Depth of each node; 0 is the first drafted position.
    """

    tokens: tuple[int, ...]
    parents: tuple[int, ...]
    depths: tuple[int, ...]

    @classmethod
    def build(cls, tokens: Sequence[int], parents: Sequence[int] | None = None) -> TokenTree:
        n = len(tokens)
        if parents is None:
            return cls(tuple(tokens), tuple(range(ROOT, n - 1)), tuple(range(n)))
        depths: list[int] = []
        for i, parent in enumerate(parents):
            if not ROOT <= parent < i:
                raise ValueError(f"node {i} has parent {parent}: parents come before their children")
            depths.append(0 if parent == ROOT else depths[parent] + 1)
        return cls(tuple(tokens), tuple(parents), tuple(depths))

    def __len__(self) -> int:
        return len(self.tokens)

    @property
    def levels(self) -> int:
        depth = max(self.depths, default=-1) + 1
        return depth if depth < len(self) else 0

    def down_from(self, node: int) -> list[int]:
        """Return the path from `node` down to a leaf, `node` first. At each node the path goes to the first child."""
        nodes = [node]
        for i in range(node + 1, len(self)):
            if self.parents[i] == nodes[-1]:
                nodes.append(i)
        return nodes

    def path_to(self, node: int) -> list[int]:
        """Return the nodes from depth 0 down to `node`, `node` included. Empty if `node` is −1, the root."""
        path: list[int] = []
        while node != ROOT:
            path.append(node)
            node = self.parents[node]
        return path[::-1]


def merge(chains: Sequence[Sequence[int]]) -> TokenTree:
    """Merge several token sequences into one prefix tree. Sequences share the nodes of a common beginning."""
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    for chain in chains:
        node = ROOT
        for token in map(int, chain):
            if (node, token) not in children:
                children[node, token] = len(tokens)
                tokens.append(token)
                parents.append(node)
            node = children[node, token]
    return TokenTree.build(tokens, parents)


class Judged(NamedTuple):
    """A draft that the target verified.

    Attributes:
        tree: The draft, n nodes.
        target_tokens: The target's prediction after the last committed token, then after each of the n nodes.
        rejected: Index of the rejected node. None if no node was rejected.
    """

    tree: TokenTree = TokenTree((), (), ())
    target_tokens: Sequence[int] = ()
    rejected: int | None = None

    @property
    def rest(self) -> list[int]:
        """The rejected node and a path below it, for which the target predicted as if the node were accepted."""
        return [] if self.rejected is None else self.tree.down_from(self.rejected)


@dataclass(frozen=True)
class Choice:
    """What a boundary decides about the next chunk: who drafts it, and how many tokens to decode."""

    mode: str  # the proposer's name
    metric: float | None = None  # F (docs/methods.md §4.4); None if the decision does not use it
    most: int | None = None  # largest number of tokens to decode; None: the whole chunk


class Rectified(NamedTuple):
    """What a rectifier predicted after a rejection.

    Attributes:
        values: Normalised actions (S, D) of the chunk's first S control steps: first the values of the committed
            tokens, then predicted values.
        ends: Whether the chunk ends with these actions. If False, the target decodes the later steps.
    """

    values: np.ndarray
    ends: bool = True


class SkipDecision(NamedTuple):
    """What a skip rule decides about a chunk.

    Attributes:
        tokens: The N tokens of the chunk, to execute without verification. None if the target decodes the chunk.
        proposer: Name of the proposer that drafted `tokens`. PARALLEL (`record.py`) if a parallel target computed them.
        reason: The rule's reason to skip or to verify, which `DecodeRecord.reason` stores.
    """

    tokens: Sequence[int] | None = None
    proposer: str = ""
    reason: str | None = None
