"""The Llama-style trunk: RMSNorm, RoPE, SwiGLU, tree attention over a key/value cache.

Shapes: B batch, T new tokens, S cached tokens, E width, A heads, C = E / A.

The implementations give the same numbers up to rounding. On CUDA a cache of fixed shapes is written at a tensor of
slots and attended to over its whole capacity under a mask, so that one captured graph can serve every step. On a CPU a
frozen float32 stack is compiled (`program.py`), one in bfloat16 has blocked weights (`bfloat16.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.attention import Cache, Slots, attention_mask, rotate, write
from kerv_cli.targets.compact.bfloat16 import Bfloat16Layers, multiplies_bfloat16
from kerv_cli.targets.compact.captured import CapturedCache
from kerv_cli.targets.compact.packable import Packable, wants_gradient
from kerv_cli.targets.compact.program import Program

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

    def forward(self, positions: Tensor | slice) -> tuple[Tensor, Tensor]:
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
        """Compute x (B, T, E) -> (B, T, E).

        Args:
            cache: (2, B, A, capacity, C) of this layer, written at `slots`.
            mask: From `attention_mask`; without one attention is causal.
        """
        qkv = self.qkv(self.attention_norm(x))
        if isinstance(qkv, Tensor):
            x = x + self.out(self.attend(qkv, rotary, cache, slots, mask))
        else:
            x = x + self.out(qkv.attend(self.heads, *rotary))
        gate, up = self.gate_up(self.feed_norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)

    def attend(
        self,
        qkv: Tensor,
        rotary: tuple[Tensor, Tensor],
        cache: Tensor | None,
        slots: Slots | None,
        mask: Tensor | None,
    ) -> Tensor:
        """Attention of qkv (B, T, 3 E), not yet rotated -> (B, T, E)."""
        batch, tokens, width = qkv.shape
        qkv = qkv.view(batch, tokens, 3 * self.heads, self.channels)
        qk = rotate(qkv[:, :, : 2 * self.heads], *rotary)
        q = qk[:, :, : self.heads].transpose(1, 2)
        k = qk[:, :, self.heads :].transpose(1, 2)
        v = qkv[:, :, 2 * self.heads :].transpose(1, 2)
        if cache is not None and slots is not None:
            k, v = write(cache, slots, k, v)
        causal = mask is None and tokens > 1
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=causal)
        return attended.transpose(1, 2).reshape(batch, tokens, width // 3)


class LayerStack(Packable):
    """Decoder layers between an entry and a norm, the base of the trunk and the drafter.

    Attributes:
        inputs: Number of tensors (B, T, E) that it takes.
        width: Width of the layers.
        outer: E, the width outside of them. Layers of a grown stack are wider (`targets/grown.py`).
    """

    inputs = 1

    def __init__(self, width: int, layers: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.width, self.outer, self.heads, self.depth = width, width, heads, layers
        self.rotary = Rotary(width // heads)
        self.layers = nn.ModuleList(Layer(width, heads, feed_forward) for _ in range(layers))
        self.norm = nn.RMSNorm(width, eps=1e-5)

    def enter(self, *inputs: Tensor) -> Tensor:
        """Join the inputs (B, T, E) to one tensor (B, T, E)."""
        return inputs[0]

    def begin(self, *inputs: Tensor) -> Tensor:
        """Return what the first layer reads, (B, T, width): the inputs, then zeros."""
        x, rest = self.enter(*inputs), self.width - self.outer
        return x if not rest else torch.cat([x, x[..., :1].expand(*x.shape[:-1], rest) * 0.0], -1)

    def finish(self, x: Tensor) -> Tensor:
        """Return the hidden states (B, T, E) of the last layer's output (B, T, width)."""
        return self.norm(x if self.width == self.outer else x[..., : self.outer])

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> Cache:
        """Return an empty cache. fixed: of fixed shapes; default: on CUDA."""
        like: Tensor = self.norm.weight
        if isinstance(self.packed, Bfloat16Layers):
            like = like.float()
        sizes = self.depth, batch, self.heads, capacity, self.width // self.heads
        fixed = like.is_cuda if fixed is None else fixed
        return CapturedCache(*sizes, like) if fixed else Cache(*sizes, like)

    def pack_weights(self) -> Program | Bfloat16Layers | None:
        """Return the compiled stack in float32, blocked layers in bfloat16 where the CPU multiplies that."""
        if self.norm.weight.dtype == torch.float32:
            return Program(self.recorded, *[(1, 1, self.outer)] * self.inputs)
        if self.norm.weight.dtype == torch.bfloat16 and multiplies_bfloat16():
            return Bfloat16Layers(self.rotary(slice(None)), self.layers)
        return None

    def run(
        self, inputs: Sequence[Tensor], positions: Tensor, cache: Cache | None, seen: np.ndarray | Tensor | None
    ) -> Tensor:
        """Return the hidden states (B, T, E) of new tokens behind the cached ones; the cache grows by T.

        Args:
            inputs: Tensors (B, T, E).
            positions: (T,) rotary positions.
            seen: As in `attention_mask`.
        """
        x = inputs[0]
        mask = attention_mask(seen, x.shape[1], cache, x)
        packed = self.packed if self.is_packed(x) and (cache is None or not cache.fixed) else None
        if isinstance(packed, Program):
            hidden = packed(*inputs, positions=positions, cache=cache, mask=mask)[0].view(x.shape)
        elif isinstance(cache, CapturedCache) and self.captures(x):
            assert mask is not None
            hidden = self.finish(cache.run(self.run_layers, self.begin(*inputs), positions, mask))
        else:
            slots = cache.next_slots(x.shape[1]) if cache is not None else None
            layers = self.run_layers if packed is None else packed
            hidden = self.finish(layers(self.begin(*inputs), positions, cache, slots, mask))
        if cache is not None:
            cache.length += x.shape[1]
        return hidden

    def captures(self, x: Tensor) -> bool:
        """Return whether a forward of x (B, T, E) over a cache of fixed shapes runs in a captured graph."""
        return x.is_cuda and x.shape[0] == 1 and not wants_gradient(x)

    def recorded(self, *inputs: Tensor) -> Tensor:
        """Return the hidden states of stand-ins for tensors, to record a program."""
        return self.finish(self.run_layers(self.begin(*inputs), slice(None), None, None, None))

    def run_layers(
        self, x: Tensor, positions: Tensor | slice, cache: Cache | None, slots: Slots | None, mask: Tensor | None
    ) -> Tensor:
        """Run the modules of the layers; keys and values go to `slots` of the cache."""
        rotary = self.rotary(positions)
        for i, layer in enumerate(self.layers):
            x = layer(x, rotary, cache.layers[i] if cache is not None else None, slots, mask)
        return x


class Trunk(LayerStack):
    """The stack whose hidden states the head and the drafter read."""

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
        return self.run((x,), positions, cache, seen)
