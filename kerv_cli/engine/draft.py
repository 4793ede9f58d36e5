"""What a proposer drafts: a `TokenTree` whose tokens may still lie on the target's device, with the positions and masks
of the forward that verifies it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from kerv_cli.engine.transfer import upload
from kerv_cli.engine.tree import ROOT, TokenTree

HOST = torch.device("cpu")


@dataclass(frozen=True)
class Draft:
    """n tokens to verify. Those on the target's device are read together with the target's tokens, so that the host
    waits once.

    tokens: (n,) int64. parents: (n,) int64; None: a chain. levels: of a tree whose parents lie on the device, at most.
    choose: where only some rows are nodes of the tree to judge: gives that tree and the row of each of its nodes, once
    `Chunk.reads` are read.
    """

    tokens: Tensor
    parents: Tensor | None = None
    levels: int = 0
    choose: Callable[[], tuple[TokenTree, Sequence[int]]] | None = None

    @classmethod
    def of(cls, tokens: Sequence[int], parents: Sequence[int] | None = None) -> Draft:
        """A draft of the host's numbers, as `TokenTree.build` takes them."""
        return cls(_vector(tokens), None if parents is None else _vector(parents))

    def __len__(self) -> int:
        return self.tokens.shape[0]

    @cached_property
    def tree(self) -> TokenTree:
        """A draft of the host as a tree; errors as `TokenTree.build`."""
        return TokenTree.build(self.tokens.tolist(), None if self.parents is None else self.parents.tolist())

    @property
    def remote(self) -> list[Tensor]:
        """Of tokens and parents, those that lie on the device."""
        return [x for x in (self.tokens, self.parents) if x is not None and x.device != HOST]

    def tokens_on(self, device: torch.device) -> Tensor:
        """(n,) int64."""
        return upload(self.tokens, device) if self.tokens.device == HOST else self.tokens

    def tokens_behind(self, token: int, device: torch.device) -> Tensor:
        """(1 + n,) int64: `token`, then the draft's."""
        if self.tokens.device == HOST:
            return upload(np.concatenate([[token], self.tokens.numpy()]), device)
        return torch.cat([torch.full_like(self.tokens[:1], token), self.tokens])

    @cached_property
    def ancestors(self) -> np.ndarray | Tensor | None:
        """(n, n) bool: row i sees row j if j is i or an ancestor of i. An array where the parents lie on the host; None
        for a chain."""
        if self.parents is None:
            return None
        if self.parents.device != HOST:
            return ancestors_on_device(self.parents, self.levels)
        parents = self.parents.tolist()
        return None if parents == list(range(ROOT, len(self) - 1)) else ancestors_of(parents)

    def positions(self, start: int, before: int, device: torch.device) -> Tensor:
        """Positions (before + n,) of `before` tokens from `start` on and the rows behind them."""
        stop, seen = start + before, self.ancestors
        if seen is None:
            return torch.arange(start, stop + len(self), device=device)
        depths = seen.sum(-1) - 1
        if isinstance(depths, np.ndarray):
            return upload(np.concatenate([np.arange(start, stop), stop + depths]), device)
        return torch.cat([torch.arange(start, stop, device=device), stop + depths])

    def visible(self, before: int) -> np.ndarray | Tensor | None:
        """(before + n, before + n) bool: which tokens each of `before` causal tokens and the n rows behind them attends
        to; None where all are causal."""
        seen, size = self.ancestors, before + len(self)
        if seen is None:
            return None
        if isinstance(seen, np.ndarray):
            on_host = np.tri(size, dtype=bool)
            on_host[before:, before:] = seen
            return on_host
        mask = torch.ones(size, size, dtype=torch.bool, device=seen.device).tril_()
        mask[before:, before:] = seen
        return mask


def _vector(numbers: Sequence[int]) -> Tensor:
    return torch.from_numpy(np.array(numbers, dtype=np.int64))


EMPTY = Draft.of(())


def ancestors_of(parents: Sequence[int]) -> np.ndarray:
    """`Draft.ancestors` of n parents on the host."""
    paths: list[int] = []  # bit j of number i: node i sees node j
    for i, parent in enumerate(parents):
        paths.append(1 << i | (paths[parent] if parent != ROOT else 0))
    n, width = len(paths), (len(paths) + 7) // 8
    rows = np.frombuffer(b"".join(path.to_bytes(width, "little") for path in paths), dtype=np.uint8)
    return np.unpackbits(rows.reshape(n, width), axis=1, count=n, bitorder="little").view(bool)


def ancestors_on_device(parents: Tensor, levels: int) -> Tensor:
    """`Draft.ancestors` of parents (n,) on their device, of a tree of at most so many levels."""
    n, nodes = parents.shape[0], torch.arange(parents.shape[0], device=parents.device)
    reached = ((parents[:, None] == nodes) | (nodes[:, None] == nodes)).float()
    for _ in range((levels - 1).bit_length() if n else 0):  # paths of 1, 2, 4, … steps
        reached = (reached @ reached).clamp_max_(1.0)
    return reached > 0
