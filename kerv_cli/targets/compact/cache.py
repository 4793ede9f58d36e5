"""A key/value cache in fixed buffers, and the slots of it that a forward writes.

Shapes: B batch, T new tokens, A heads, C channels of a head.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kerv_cli.engine.attention import Buffered


class Cache(Buffered):
    """Keys and values of every layer in fixed buffers (layers, 2, B, A, slots, C) with slots ≥ capacity; the first
    `length` slots are valid.

    fixed: every forward has the same shapes. Modules and packed weights order key channels differently, so they must
    not share a cache.
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


class Slots:
    """The slots of a cache that a forward of `tokens` tokens writes: a slice, for fixed shapes a tensor `index`
    (T,)."""

    def __init__(self, cache: Cache, tokens: int) -> None:
        self.start, self.stop = cache.length, cache.length + tokens
        self.index: Tensor | None = None
        if cache.fixed:
            self.index = torch.arange(self.start, self.stop, device=cache.buffer.device)

    @classmethod
    def at(cls, index: Tensor) -> Slots:
        """The slots `index` (T,) of a cache of fixed shapes."""
        slots = cls.__new__(cls)
        slots.start = slots.stop = 0
        slots.index = index
        return slots

    def write(self, layer: Tensor, k: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """k, v (B, A, T, C) into a layer (2, B, A, capacity, C) -> the keys and values to attend to."""
        if self.index is not None:
            layer[0].index_copy_(2, self.index, k)
            layer[1].index_copy_(2, self.index, v)
            return layer[0], layer[1]
        layer[0][:, :, self.start : self.stop] = k
        layer[1][:, :, self.start : self.stop] = v
        return (layer[0][:, :, : self.stop], layer[1][:, :, : self.stop]) if self.start else (k, v)
