"""The key/value cache of a trunk, attention to it, attention masks, and rotary position embeddings.

A slot is the place of one token's keys and values in the cache.

Shapes: B batch, T new tokens, S cached tokens, A heads (of keys and values), C channels of a head.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kerv_cli.engine.transfer import upload


class Cache:
    """Keys and values of every layer and token.

    Args:
        layers: Number of layers.
        batch: B, number of sequences.
        heads: A, number of heads.
        capacity: Maximum number of tokens.
        channels: C, channels of a head.
        like: Tensor whose device and number format the cache gets.
        fixed: Whether every forward attends to all slots, with a mask that hides the unused ones. Then all shapes are
            fixed, as CUDA graphs require.

    Attributes:
        buffer: (layers, 2, B, A, slots, C) keys and values. A fixed cache has a spare slot after its capacity.
        layers: (2, B, A, slots, C) per layer, views of the buffer.
        length: Number of cached tokens. They are in the first slots.
    """

    def __init__(
        self, layers: int, batch: int, heads: int, capacity: int, channels: int, like: Tensor, fixed: bool = False
    ) -> None:
        self.fixed = fixed
        slots = capacity + fixed  # a spare slot, for the unused rows of a CUDA graph
        self.buffer = like.new_zeros((layers, 2, batch, heads, slots, channels))
        self.layers = list(self.buffer)  # (2, B, A, slots, C): keys, values
        self.capacity = capacity
        self.length = 0

    def compact(self, start: int, slots: Tensor) -> None:
        """Keep the tokens of an accepted path, and drop the rest of the draft tree.

        The kept entries move to the slots start, start + 1, …. The cache then ends with the last of them.

        Args:
            start: The first slot to write.
            slots: (n,) slots of the kept tokens in increasing order, none before `start`.
        """
        n = slots.shape[0]
        self.buffer[..., start : start + n, :] = self.buffer.index_select(-2, slots)
        self.length = start + n

    def next_slots(self, tokens: int) -> Slots:
        """Return the slots for a number of new tokens, the first ones after the cached tokens."""
        start, stop = self.length, self.length + tokens
        return torch.arange(start, stop, device=self.buffer.device) if self.fixed else slice(start, stop)


Slots = slice | Tensor
"""Slots of a cache that a forward writes: a slice, or for a cache of fixed shapes indices (T,)."""


def attend(q: Tensor, k: Tensor, v: Tensor, cache: Tensor | None, slots: Slots | None, mask: Tensor | None) -> Tensor:
    """Return the attention's result (B, T, A · C) of new tokens, and write their keys and values to the cache.

    Args:
        q: (B, A, T, C) queries. Several heads may share one head of keys and values.
        k: (B, K, T, C) keys.
        v: (B, K, T, C) values.
        cache: (2, B, K, slots, C) keys and values of this layer. None: there are no earlier tokens.
        slots: Slots of the new tokens. None if there is no cache.
        mask: Result of `attention_mask`. None: attention is causal.
    """
    causal = mask is None and q.shape[2] > 1
    if cache is not None and isinstance(slots, Tensor):
        cache[0].index_copy_(2, slots, k)
        cache[1].index_copy_(2, slots, v)
        k, v = cache
    elif cache is not None and isinstance(slots, slice):
        cache[0][:, :, slots] = k
        cache[1][:, :, slots] = v
        if slots.start:
            k, v = cache[:, :, :, : slots.stop]
    shared = k.shape[1] != q.shape[1]
    attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=causal, enable_gqa=shared)
    return attended.transpose(1, 2).flatten(2)


def attention_mask(seen: np.ndarray | Tensor | None, tokens: int, cache: Cache | None, like: Tensor) -> Tensor | None:
    """Return the additive attention mask of new tokens: 0 for tokens that are seen, -inf for hidden ones.

    Args:
        seen: (T, M) bool, which of the last M ≥ T tokens each new token attends to. The new tokens are the last T of
            these M. All cached tokens before the M are seen. None: attention is causal. A tensor must be on the device
            of `like`.
        tokens: T, number of new tokens.
        cache: Cache of earlier tokens. None: there are none.
        like: Tensor whose device and number format the mask gets.

    Returns:
        (T, S + T), or (T, slots) for a cache of fixed shapes. None if no mask is needed.
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
    """Apply rotary position embedding.

    Args:
        x: (B, T, heads, C) queries or keys, or (B, heads, T, C).
        cos: Cosines of the positions, (T, 1, C) for the first shape of x, (T, C) for the second.
        sin: Sines, likewise. Those of the first half of the channels are negative.
    """
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)
