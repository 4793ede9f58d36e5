"""Attention of a trunk that decodes with a cache: the cache, its slots, the mask and the rotation.

Shapes: B batch, T new tokens, S cached tokens, A heads (of keys and values), C channels of a head.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from kerv_cli.engine.transfer import upload


class Cache:
    """Keys and values of every layer in buffers (layers, 2, B, A, slots, C) with slots ≥ capacity.

    Modules and packed weights order key channels differently, so they must not share a cache.

    Attributes:
        fixed: Whether every forward has the same shapes: it attends to all slots under a mask.
        length: The number of valid slots, from the first on.
    """

    def __init__(
        self, layers: int, batch: int, heads: int, capacity: int, channels: int, like: Tensor, fixed: bool = False
    ) -> None:
        self.fixed = fixed
        slots = capacity + fixed  # a spare one, for the rows that fill up a graph's bucket
        self.buffer = like.new_zeros((layers, 2, batch, heads, slots, channels))
        self.layers = list(self.buffer)  # (2, B, A, slots, C): keys, values
        self.capacity = capacity
        self.length = 0

    def compact(self, start: int, slots: Tensor) -> None:
        """Commit a path: move the entries at `slots` (n,) to start, start + 1, … and set the length after them.

        Args:
            start: The first slot to write.
            slots: Slots in increasing order, none before `start`.
        """
        n = slots.shape[0]
        self.buffer[..., start : start + n, :] = self.buffer.index_select(-2, slots)
        self.length = start + n

    def next_slots(self, tokens: int) -> Slots:
        """Return the slots after the valid ones for a number of new tokens."""
        start, stop = self.length, self.length + tokens
        return torch.arange(start, stop, device=self.buffer.device) if self.fixed else slice(start, stop)


Slots = slice | Tensor
"""Slots of a cache that a forward of T tokens writes: a slice, or for fixed shapes their indices (T,)."""


def write(layer: Tensor, slots: Slots, k: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Write k and v (B, A, T, C) into a layer (2, B, A, capacity, C). Return the keys and values to attend to."""
    if isinstance(slots, Tensor):
        layer[0].index_copy_(2, slots, k)
        layer[1].index_copy_(2, slots, v)
        return layer[0], layer[1]
    layer[0][:, :, slots] = k
    layer[1][:, :, slots] = v
    return (layer[0][:, :, : slots.stop], layer[1][:, :, : slots.stop]) if slots.start else (k, v)


def attention_mask(seen: np.ndarray | Tensor | None, tokens: int, cache: Cache | None, like: Tensor) -> Tensor | None:
    """Return the additive mask of new tokens after a cache: (T, S + T), or (T, slots) for a cache of fixed shapes.

    Args:
        seen: (T, M) bool: which of the newest M ≥ T tokens, the new ones last, each new token attends to. It attends to
            all cached tokens before those. None means that new tokens are causal. A tensor must be on the device of
            `like`.
        tokens: T.
        cache: Cache of earlier tokens.
        like: Tensor whose device and number format the mask gets.

    Returns:
        The mask. None if attention without one does the same.
    """
    cached, fixed = (cache.length, cache.fixed) if cache is not None else (0, False)
    stop = cached + tokens
    slots = cache.buffer.shape[-2] if cache is not None and fixed else stop
    if isinstance(seen, Tensor):
        mask = like.new_zeros(tokens, slots)
        mask[:, stop - seen.shape[1] : stop].masked_fill_(~seen, -torch.inf)
        mask[:, stop:] = -torch.inf
        return mask
    plain = (tokens == 1 or not cached) if seen is None else (tokens == 1 and seen.all())
    if plain and not fixed:
        return None
    if seen is None:
        seen = np.tri(tokens, dtype=bool)
    rows = np.zeros((tokens, slots), dtype=np.float32)
    rows[:, stop - seen.shape[1] : stop][~seen] = -np.inf
    rows[:, stop:] = -np.inf
    return upload(rows, like.device).to(like.dtype)


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate x by its positions' cos and sin: (B, T, heads, C) by (T, 1, C), or (B, heads, T, C) by (T, C)."""
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)
