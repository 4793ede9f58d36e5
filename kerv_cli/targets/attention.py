"""Attention of a trunk that decodes with a cache: the cache, its slots, the mask and the rotation. Both families of
targets use it.

Shapes: B batch, T new tokens, S cached tokens, A heads (of keys and values), C channels of a head.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from kerv_cli.engine.transfer import upload


class Cache:
    """Keys and values of every layer in fixed buffers (layers, 2, B, A, slots, C) with slots ≥ capacity; the first
    `length` slots are valid.

    fixed: every forward has the same shapes: it attends to all slots under a mask. Modules and packed weights order key
    channels differently, so they must not share a cache.
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
        """Commits a path: moves the entries at `slots` (n,), increasing and from `start` on, to start, start + 1, … and
        sets the length behind them."""
        n = slots.shape[0]
        self.buffer[..., start : start + n, :] = self.buffer.index_select(-2, slots)
        self.length = start + n

    def next_slots(self, tokens: int) -> Slots:
        """The slots behind the valid ones, for so many tokens."""
        start, stop = self.length, self.length + tokens
        return torch.arange(start, stop, device=self.buffer.device) if self.fixed else slice(start, stop)


Slots = slice | Tensor
"""Slots of a cache that a forward of T tokens writes: a slice, for fixed shapes their indices (T,)."""


def write(layer: Tensor, slots: Slots, k: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """k, v (B, A, T, C) into the slots of a layer (2, B, A, capacity, C) -> the keys and values to attend to."""
    if isinstance(slots, Tensor):
        layer[0].index_copy_(2, slots, k)
        layer[1].index_copy_(2, slots, v)
        return layer[0], layer[1]
    layer[0][:, :, slots] = k
    layer[1][:, :, slots] = v
    return (layer[0][:, :, : slots.stop], layer[1][:, :, : slots.stop]) if slots.start else (k, v)


def attention_mask(seen: np.ndarray | Tensor | None, tokens: int, cache: Cache | None, like: Tensor) -> Tensor | None:
    """Additive mask of T = `tokens` new tokens behind a cache: (T, S + T); (T, slots) for a cache of fixed shapes.

    seen (T, M) bool says which of the newest M ≥ T tokens, the new ones last, each new token attends to; it attends to
    all cached ones before those. None: the new tokens are causal. The mask is None where attention without one does the
    same. A tensor `seen` lies on the device of `like`, where its mask is made.
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
    """x rotated by its positions' cos and sin: x (B, T, heads, C) with (T, 1, C), or (B, heads, T, C) with (T, C)."""
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)
