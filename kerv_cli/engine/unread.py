"""Drafts that lie on the target's device. The round that verifies them reads them together with the target's tokens,
so that the host waits once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.engine.tree import TokenTree

Placed = tuple[TokenTree, Sequence[int]]
"""A draft that was read, and the row of each of its nodes."""


@dataclass(frozen=True)
class Unread:
    """n rows to forward, and how they become a tree.

    tokens: (n,) int64. numbers: (m,) what has to be read. placed: those m numbers -> the tree. visible: (n, n) bool,
    rows that each row attends to; None: a chain. depths: (n,) int64, depth of each row; None: of a chain.
    """

    tokens: Tensor
    numbers: Tensor
    placed: Callable[[np.ndarray], Placed]
    visible: Tensor | None = None
    depths: Tensor | None = None

    @classmethod
    def chain(cls, tokens: Tensor) -> Unread:
        """tokens (n,) int64, each behind the one before it."""
        return cls(tokens, tokens, chain_of)

    @classmethod
    def tree(cls, tokens: Tensor, parents: Tensor, depth: int) -> Unread:
        """tokens, parents (n,) int64, parents before their children, ROOT −1; at most `depth` levels."""
        seen = ancestors(parents, depth)
        return cls(tokens, torch.cat([tokens, parents]), tree_of, seen, seen.sum(-1) - 1)

    def __len__(self) -> int:
        return self.tokens.shape[0]

    def positions(self, start: int, before: int) -> Tensor:
        """Positions (before + n,) of `before` tokens from `start` on and the rows behind them."""
        stop, device = start + before, self.tokens.device
        if self.depths is None:
            return torch.arange(start, stop + len(self), device=device)
        return torch.cat([torch.arange(start, stop, device=device), stop + self.depths])

    def seen(self, before: int) -> Tensor | np.ndarray | None:
        """As `tree.visible_in_prefill`: `before` causal tokens, then the rows; None where all is causal. An array on a
        CPU, on other devices a tensor there."""
        if self.visible is None:
            return None
        n = len(self)
        seen = torch.ones(before + n, before + n, dtype=torch.bool, device=self.tokens.device).tril_()
        seen[before:, before:] = self.visible
        return seen.numpy() if seen.device.type == "cpu" else seen


def chain_of(tokens: np.ndarray) -> Placed:
    """n tokens -> a chain."""
    return TokenTree.chain(tokens.tolist()), range(len(tokens))


def tree_of(numbers: np.ndarray) -> Placed:
    """n tokens, then n parents -> a tree."""
    tokens, parents = numbers.reshape(2, -1).tolist()
    return TokenTree.build(tokens, parents), range(len(tokens))


def ancestors(parents: Tensor, depth: int) -> Tensor:
    """parents (n,) int64 of a tree of at most `depth` levels -> (n, n) bool as `TokenTree.ancestors`, computed where
    the parents are."""
    n, nodes = parents.shape[0], torch.arange(parents.shape[0], device=parents.device)
    reached = ((parents[:, None] == nodes) | (nodes[:, None] == nodes)).float()
    for _ in range((depth - 1).bit_length() if n else 0):  # paths of 1, 2, 4, … steps
        reached = (reached @ reached).clamp_max_(1.0)
    return reached > 0
