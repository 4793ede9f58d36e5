"""The Llama-style trunk: RMSNorm, RoPE, SwiGLU, tree attention over a key/value cache.

Shapes: B batch, T new tokens, S cached tokens, E width, A heads, C = E / A.

These implementations give the same numbers up to rounding. On CUDA a cache of fixed shapes is written at a
tensor of slots and attended to over its whole capacity under a mask, so that one captured graph can serve every step.
On a CPU slices are faster, and a frozen stack has packed weights (`packed.py`, `packed_bfloat16.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.attention import Cache, Slots, attention_mask, rotate, write
from kerv_cli.targets.compact.captured import CapturedCache
from kerv_cli.targets.compact.packable import Packable, Packed, wants_gradient

POSITIONS, BASE = 1024, 10_000.0  # of the rotary embedding


class Rotary(nn.Module):
    """Rotary position embedding, half-split layout; tables are computed once in float32."""

    cos: Tensor
    sin: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        frequencies = BASE ** (-torch.arange(0, channels, 2, dtype=torch.float32) / channels)
        angles = torch.arange(POSITIONS, dtype=torch.float32)[:, None] * frequencies
        self.register_buffer("cos", torch.cat([angles.cos(), angles.cos()], -1), persistent=False)
        # the sign of the swapped half is folded into the table: x·cos + swap(x)·sin
        self.register_buffer("sin", torch.cat([-angles.sin(), angles.sin()], -1), persistent=False)

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """positions (T,) -> cos and sin (T, 1, C) for all layers."""
        return self.cos[positions][:, None], self.sin[positions][:, None]


class Layer(nn.Module):
    """One pre-norm decoder layer with fused projections."""

    def __init__(self, width: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.heads, self.channels = heads, width // heads
        self.attention_norm = nn.RMSNorm(width, eps=1e-5)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.out = nn.Linear(width, width, bias=False)
        self.feed_norm = nn.RMSNorm(width, eps=1e-5)
        self.gate_up = nn.Linear(width, 2 * feed_forward, bias=False)
        self.down = nn.Linear(feed_forward, width, bias=False)

    def forward(
        self,
        x: Tensor,
        rotary: tuple[Tensor, Tensor],
        cache: Tensor | None = None,
        slots: Slots | None = None,
        mask: Tensor | None = None,
    ) -> Tensor:
        """x (B, T, E) -> (B, T, E). cache: (2, B, A, capacity, C) of this layer, written at `slots`. mask: from
        `attention_mask`; without one attention is causal."""
        batch, tokens, width = x.shape
        qkv = self.qkv(self.attention_norm(x)).view(batch, tokens, 3 * self.heads, self.channels)
        qk = rotate(qkv[:, :, : 2 * self.heads], *rotary)
        q = qk[:, :, : self.heads].transpose(1, 2)
        k = qk[:, :, self.heads :].transpose(1, 2)
        v = qkv[:, :, 2 * self.heads :].transpose(1, 2)
        if cache is not None and slots is not None:
            k, v = write(cache, slots, k, v)
        causal = mask is None and tokens > 1
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=causal)
        x = x + self.out(attended.transpose(1, 2).reshape(batch, tokens, width))
        gate, up = self.gate_up(self.feed_norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)


class PackedStack(Packed, ABC):
    """Packed weights of a stack's layers and its final norm. cache_dtype: number format of its caches, by default that
    of the weights."""

    cache_dtype: torch.dtype | None = None

    @abstractmethod
    def __call__(self, x: Tensor, positions: Tensor, cache: Cache | None, mask: Tensor | None) -> Tensor:
        """x (B, T, E) -> hidden states (B, T, E) before the norm; the cache's length stays. mask: from
        `attention_mask`."""

    @abstractmethod
    def norm(self, x: Tensor) -> Tensor:
        """The final RMSNorm with its gain."""


class LayerStack(Packable):
    """Decoder layers and their rotary embedding, the base of the trunk and the drafter."""

    packed: PackedStack | None

    def __init__(self, width: int, layers: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.width, self.heads, self.depth = width, heads, layers
        self.rotary = Rotary(width // heads)
        self.layers = nn.ModuleList(Layer(width, heads, feed_forward) for _ in range(layers))
        self.norm = nn.RMSNorm(width, eps=1e-5)

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> Cache:
        """An empty cache. fixed: of fixed shapes; default: on CUDA."""
        like: Tensor = self.norm.weight
        if self.packed is not None and self.packed.cache_dtype is not None:
            like = like.to(self.packed.cache_dtype)
        sizes = self.depth, batch, self.heads, capacity, self.width // self.heads
        fixed = like.is_cuda if fixed is None else fixed
        return CapturedCache(*sizes, like) if fixed else Cache(*sizes, like)

    def packed_for(self, x: Tensor, cache: Cache | None) -> PackedStack | None:
        """The packed weights where they can compute x: without gradients, and with no cache of fixed shapes."""
        return None if wants_gradient(x) or (cache is not None and cache.fixed) else self.packed

    def captures(self, x: Tensor, cache: Cache | None) -> bool:
        """Whether a captured graph computes x: one sequence on CUDA, without gradients, in a cache of fixed shapes."""
        return x.is_cuda and x.shape[0] == 1 and cache is not None and cache.fixed and not wants_gradient(x)

    def run_layers(self, x: Tensor, positions: Tensor, cache: Cache | None, seen: np.ndarray | Tensor | None) -> Tensor:
        """x (B, T, E) at `positions` (T,) -> output of the last layer (B, T, E); the cache grows by T. seen: as in
        `attention_mask`."""
        mask = attention_mask(seen, x.shape[1], cache, x)
        packed = self.packed_for(x, cache)
        if packed is not None:
            x = packed(x, positions, cache, mask)
        elif self.captures(x, cache):
            assert isinstance(cache, CapturedCache)
            assert mask is not None
            x = cache.run(self.compute, x, positions, mask)
        else:
            slots = cache.next_slots(x.shape[1]) if cache is not None else None
            x = self.compute(x, positions, cache, slots, mask)
        if cache is not None:
            cache.length += x.shape[1]
        return x

    def compute(
        self, x: Tensor, positions: Tensor, cache: Cache | None, slots: Slots | None, mask: Tensor | None
    ) -> Tensor:
        """Runs the modules of the layers; keys and values go to `slots` of the cache, whose length stays; mask: from
        `attention_mask`."""
        rotary = self.rotary(positions)
        for i, layer in enumerate(self.layers):
            x = layer(x, rotary, cache.layers[i] if cache is not None else None, slots, mask)
        return x


class Trunk(LayerStack):
    """The stack and its final norm; its output is the hidden state that the head and the drafter read."""

    def __init__(self, width: int, layers: int, heads: int, feed_forward: int) -> None:
        super().__init__(width, layers, heads, feed_forward)
        for name, parameter in self.named_parameters():
            if parameter.dim() == 2:
                nn.init.normal_(parameter, std=0.02)
                if name.endswith(("out.weight", "down.weight")):
                    parameter.data /= (2 * layers) ** 0.5

    def forward(
        self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: np.ndarray | Tensor | None = None
    ) -> Tensor:
        """Hidden states (B, T, E) of the new tokens x (B, T, E) at rotary `positions` (T,), behind the cached ones."""
        packed = self.packed_for(x, cache)
        x = self.run_layers(x, positions, cache, seen)
        return self.norm(x) if packed is None else packed.norm(x)
