"""A draft to verify: its tokens, on CPU or GPU, their positions and attention mask. Also copies to and from a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kerv_cli.base.errors import KervError
from kerv_cli.engine.chunk import check_tokens
from kerv_cli.engine.decisions import ROOT, TokenTree

HOST = torch.device("cpu")


@dataclass(frozen=True)
class Draft:
    """n draft tokens to verify.

    Draft tokens on a GPU are copied to the CPU together with the target's tokens. So the CPU waits only once per round.

    Attributes:
        tokens: (n,) int64.
        parents: Index of each token's parent, (n,) int64; −1 is the last committed token. None for a chain.
        levels: Maximum depth of the tree. Needed only when `parents` is on the GPU.
        paths: The mask `ancestors`, if the proposer has computed it already.
    """

    tokens: Tensor
    parents: Tensor | None = None
    levels: int = 0
    paths: np.ndarray | None = None

    @classmethod
    def of(cls, tokens: Sequence[int], parents: Sequence[int] | None = None) -> Draft:
        """Build a draft on the CPU."""
        return cls(_vector(tokens), None if parents is None else _vector(parents))

    def __len__(self) -> int:
        return self.tokens.shape[0]

    def check(self, vocabulary: int, proposer: str, depth: int) -> None:
        device, reached = self.tokens.device, len(self)
        if self.parents is not None and self.parents.device != device:
            raise KervError(
                f"the proposer '{proposer}' drafted tokens on {device} and parents on {self.parents.device}: put "
                "both on one device"
            )
        if device == HOST:
            try:
                reached = max(self.tree.depths, default=-1) + 1
            except ValueError as error:
                raise KervError(f"the proposer '{proposer}' drafted an invalid tree: {error}") from error
            check_tokens(self.tree.tokens, vocabulary, proposer)
        elif self.parents is not None:
            reached = self.levels
            if len(self) and not reached:
                raise KervError(f"the proposer '{proposer}' drafted a tree on {device} without Draft.levels")
        if reached > depth:
            raise KervError(
                f"the proposer '{proposer}' drafted {reached} tokens on a path: at most {depth} fit into the chunk"
            )

    @cached_property
    def tree(self) -> TokenTree:
        return TokenTree.build(self.tokens.tolist(), None if self.parents is None else self.parents.tolist())

    @property
    def remote(self) -> list[Tensor]:
        return [x for x in (self.tokens, self.parents) if x is not None and x.device != HOST]

    def judged(self, remote: Sequence[np.ndarray]) -> TokenTree:
        return TokenTree.build(*(vector.astype(np.int64).tolist() for vector in remote)) if remote else self.tree

    def tokens_after(self, committed: list[int], device: torch.device) -> Tensor:
        """Return the k tokens in `committed`, followed by the draft's n tokens: (k + n,) int64 on `device`."""
        if self.tokens.device == HOST:
            return upload([*committed, *self.tree.tokens], device)
        return torch.cat([upload(committed, device), self.tokens]) if committed else self.tokens

    @cached_property
    def ancestors(self) -> np.ndarray | Tensor | None:
        """Mask (n, n) bool, on the device of `parents`. None for a chain.

        Entry [i, j] says whether token j is token i or one of its ancestors.
        """
        if self.parents is None:
            return None
        if self.parents.device != HOST:
            return ancestors_on_device(self.parents, self.levels)
        if self.paths is not None:
            return self.paths
        parents = self.tree.parents
        return None if parents == tuple(range(ROOT, len(self) - 1)) else ancestors_of(parents)

    def positions(self, start: int, before: int, device: torch.device) -> Tensor:
        """Return the positions (before + n,) of `before` tokens, the first at `start`, and of the draft after them."""
        stop, seen = start + before, self.ancestors
        if seen is None:
            return consecutive(start, stop + len(self), device)
        if isinstance(seen, np.ndarray):
            return upload([*range(start, stop), *(stop + depth for depth in self.tree.depths)], device)
        return torch.cat([torch.arange(start, stop, device=device), stop - 1 + seen.sum(-1)])

    def visible(self, before: int) -> np.ndarray | Tensor | None:
        """Return the attention mask of `before` tokens and the draft after them, (before + n, before + n) bool.

        None if attention is causal.
        """
        seen, size = self.ancestors, before + len(self)
        if seen is None:
            return None
        mask: Any
        if isinstance(seen, Tensor):
            mask = torch.ones(size, size, dtype=torch.bool, device=seen.device).tril_()
        else:
            mask = lower_triangle(size).copy()
        mask[before:, before:] = seen
        return mask


def _vector(numbers: Sequence[int]) -> Tensor:
    return torch.from_numpy(np.array(numbers, dtype=np.int64))


EMPTY = Draft.of(())


@lru_cache(maxsize=256)
def lower_triangle(size: int) -> np.ndarray:
    return np.tri(size, dtype=bool)


# both return `Draft.ancestors`, (n, n) bool
def ancestors_of(parents: Sequence[int]) -> np.ndarray:
    paths: list[int] = []  # bit j of number i: node j is node i or its ancestor
    for i, parent in enumerate(parents):
        paths.append(1 << i | (paths[parent] if parent != ROOT else 0))
    n, width = len(paths), (len(paths) + 7) // 8
    rows = np.frombuffer(b"".join(path.to_bytes(width, "little") for path in paths), dtype=np.uint8)
    return np.unpackbits(rows.reshape(n, width), axis=1, count=n, bitorder="little").view(bool)


def ancestors_on_device(parents: Tensor, levels: int) -> Tensor:
    n, nodes = parents.shape[0], torch.arange(parents.shape[0], device=parents.device)
    reached = ((parents[:, None] == nodes) | (nodes[:, None] == nodes)).float()
    for _ in range((levels - 1).bit_length() if n else 0):  # doubles the path length: 1, 2, 4, … steps
        reached = (reached @ reached).clamp_max_(1.0)
    return reached > 0


def consecutive(start: int, stop: int, device: torch.device) -> Tensor:
    # numpy is several times as fast as torch for so few numbers
    return torch.from_numpy(np.arange(start, stop)) if device == HOST else torch.arange(start, stop, device=device)


def upload(numbers: ArrayLike, device: torch.device) -> Tensor:
    """Return integers as a tensor on the device, without waiting for the copy."""
    host = torch.from_numpy(np.asarray(numbers))  # five times as fast as torch.as_tensor for a list
    if device.type == "cpu":
        return host
    if device.type == "cuda":
        host = host.pin_memory()  # PyTorch's allocator keeps it until the copy is done
    return host.to(device, non_blocking=True)


def read(*parts: Tensor) -> list[np.ndarray]:
    """Copy several vectors from one device to the CPU in a single transfer, and wait for it."""
    if len(parts) == 1:
        return [parts[0].cpu().numpy()]
    mixed = len({part.dtype for part in parts}) > 1
    together = torch.cat([*map(Tensor.double, parts)] if mixed else parts)
    return [vector.numpy() for vector in together.cpu().split(list(map(len, parts)))]
