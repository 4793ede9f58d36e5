"""Draft tokens as a tree, which an acceptance rule judges. Nothing heavy is imported here.

Node i has a token, a parent (−1: the last committed token) and a depth (0 for the first drafted position). Parents come
before their children. A node at depth d behind `committed` tokens is chunk token committed + d, which gives its control
step and DoF (docs/methods.md §2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

ROOT = -1


@dataclass(frozen=True)
class TokenTree:
    """A draft on the host: tokens, parents and depths of n nodes, parent before child."""

    tokens: tuple[int, ...]
    parents: tuple[int, ...]
    depths: tuple[int, ...]

    @classmethod
    def build(cls, tokens: Sequence[int], parents: Sequence[int] | None = None) -> TokenTree:
        """A tree of n tokens with n parents; without parents one path.

        Raises:
            ValueError: a parent at or behind its child.
        """
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

    def down_from(self, node: int) -> list[int]:
        """`node` and the nodes below it along first children, down to a leaf."""
        nodes = [node]
        for i in range(node + 1, len(self)):
            if self.parents[i] == nodes[-1]:
                nodes.append(i)
        return nodes

    def path_to(self, node: int) -> list[int]:
        """Nodes from depth 0 down to `node`; empty for the root."""
        path: list[int] = []
        while node != ROOT:
            path.append(node)
            node = self.parents[node]
        return path[::-1]


def merge(chains: Sequence[Sequence[int]]) -> TokenTree:
    """A prefix tree of several drafts; common beginnings become one path."""
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    for chain in chains:
        node = ROOT
        for token in chain:
            key = (node, int(token))
            if key not in children:
                children[key] = len(tokens)
                tokens.append(int(token))
                parents.append(node)
            node = children[key]
    return TokenTree.build(tokens, parents)
