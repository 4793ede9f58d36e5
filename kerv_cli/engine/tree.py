"""TokenTree: a proposer's draft, and the attention masks that verify it.

Node i has a token, a parent (−1: the last committed token) and a depth (0 for the first drafted position). Parents come
before their children. A node at depth d behind `committed` tokens is chunk token committed + d, so its control step and
DoF are known (docs/methods.md §2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ROOT = -1


@dataclass(frozen=True)
class TokenTree:
    """tokens, parents and depths of n nodes, parent before child."""

    tokens: tuple[int, ...]
    parents: tuple[int, ...]
    depths: tuple[int, ...]

    @classmethod
    def build(cls, tokens: Sequence[int], parents: Sequence[int]) -> TokenTree:
        """A tree of n tokens with n parents; depths are derived.

        Raises:
            ValueError: a parent at or behind its child.
        """
        depths: list[int] = []
        for i, parent in enumerate(parents):
            if not ROOT <= parent < i:
                raise ValueError(f"node {i} has parent {parent}: parents come before their children")
            depths.append(0 if parent == ROOT else depths[parent] + 1)
        return cls(tuple(tokens), tuple(parents), tuple(depths))

    @classmethod
    def chain(cls, tokens: Sequence[int]) -> TokenTree:
        """A tree of one path: every token is the child of the one before it."""
        n = len(tokens)
        return cls(tuple(tokens), tuple(range(-1, n - 1)), tuple(range(n)))

    def __len__(self) -> int:
        return len(self.tokens)

    @property
    def is_chain(self) -> bool:
        """Whether every node's parent is the node before it."""
        return self.parents == tuple(range(-1, len(self) - 1))

    def ancestors(self) -> np.ndarray:
        """(n, n) bool: node i sees node j if j is i or an ancestor of i."""
        paths: list[int] = []  # bit j of number i: node i sees node j
        for i, parent in enumerate(self.parents):
            paths.append(1 << i | (paths[parent] if parent != ROOT else 0))
        n, width = len(paths), (len(paths) + 7) // 8
        rows = np.frombuffer(b"".join(path.to_bytes(width, "little") for path in paths), dtype=np.uint8)
        return np.unpackbits(rows.reshape(n, width), axis=1, count=n, bitorder="little").view(bool)

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


EMPTY = TokenTree((), (), ())


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


def visible_in_prefill(tree: TokenTree, prompt: int) -> np.ndarray:
    """(P + n, P + n) bool for [prompt, nodes…]: causal in the prompt; a node sees the prompt and its path."""
    n = len(tree)
    visible = np.tri(prompt + n, dtype=bool)
    visible[prompt:, prompt:] = tree.ancestors()
    return visible


def visible_in_verification(tree: TokenTree) -> np.ndarray:
    """(1 + n, 1 + n) bool for [last committed token, nodes…]: a node sees that token, its ancestors and itself."""
    n = len(tree)
    visible = np.zeros((1 + n, 1 + n), dtype=bool)
    visible[:, 0] = True
    visible[1:, 1:] = tree.ancestors()
    return visible
