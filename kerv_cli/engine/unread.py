"""Drafts that lie on the target's device. The round that verifies them reads them together with the target's tokens,
so that the host waits once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.engine.tree import TokenTree

TreeRows = tuple[TokenTree, Sequence[int]]
"""A draft on the host, and the forwarded row of each of its nodes."""


@dataclass(frozen=True)
class Unread:
    """A draft on the device: n rows to forward, and how the host makes a tree of them.

    tokens: (n,) int64. numbers: (m,), the vector that the host reads. assemble: those m numbers -> the tree. visible:
    (n, n) bool, rows that each row attends to; None: a chain. depths: (n,) int64, depth of each row; None: of a chain.
    """

    tokens: Tensor
    numbers: Tensor
    assemble: Callable[[np.ndarray], TreeRows]
    visible: Tensor | None = None
    depths: Tensor | None = None

    @classmethod
    def chain(cls, tokens: Tensor) -> Unread:
        """tokens (n,) int64, each behind the one before it."""
        return cls(tokens, tokens, chain_of)

    @classmethod
    def tree(cls, tokens: Tensor, parents: Tensor, depth: int) -> Unread:
        """tokens, parents (n,) int64, parents before their children, ROOT −1; at most `depth` levels."""
        visible = ancestors(parents, depth)
        return cls(tokens, torch.cat([tokens, parents]), tree_of, visible, visible.sum(-1) - 1)

    def __len__(self) -> int:
        return self.tokens.shape[0]

    def positions(self, start: int, before: int) -> Tensor:
        """Positions (before + n,) of `before` tokens from `start` on and the rows behind them."""
        stop, device = start + before, self.tokens.device
        if self.depths is None:
            return torch.arange(start, stop + len(self), device=device)
        return torch.cat([torch.arange(start, stop, device=device), stop + self.depths])

    def seen(self, before: int) -> Tensor | np.ndarray | None:
        """(before + n, before + n) bool: which tokens each of `before` causal tokens and the n rows behind them attends
        to; None where all are causal. An array on a CPU, else a tensor on the draft's device."""
        if self.visible is None:
            return None
        n = len(self)
        mask = torch.ones(before + n, before + n, dtype=torch.bool, device=self.tokens.device).tril_()
        mask[before:, before:] = self.visible
        return mask.numpy() if mask.device.type == "cpu" else mask


def chain_of(tokens: np.ndarray) -> TreeRows:
    """n tokens -> a chain."""
    return TokenTree.chain(tokens.tolist()), range(len(tokens))


def tree_of(numbers: np.ndarray) -> TreeRows:
    """n tokens, then n parents -> a tree."""
    tokens, parents = numbers.reshape(2, -1).tolist()
    return TokenTree.build(tokens, parents), range(len(tokens))


def ancestors(parents: Tensor, depth: int) -> Tensor:
    """parents (n,) int64 of a tree of at most `depth` levels -> (n, n) bool, true where j is i or an ancestor of i;
    on the device of `parents`."""
    n, nodes = parents.shape[0], torch.arange(parents.shape[0], device=parents.device)
    reached = ((parents[:, None] == nodes) | (nodes[:, None] == nodes)).float()
    for _ in range((depth - 1).bit_length() if n else 0):  # paths of 1, 2, 4, … steps
        reached = (reached @ reached).clamp_max_(1.0)
    return reached > 0
