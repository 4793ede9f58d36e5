"""The Llama-style trunk: RMSNorm, RoPE, SwiGLU, a static key/value cache, tree masks.

Everything a forward depends on is a tensor (positions, cache slots, mask), so one compiled or captured graph can serve
every step. Shapes: B batch, T new tokens, S cached tokens, E width, A heads, C = E / A.

There are two paths to the same numbers (up to float32 rounding): these modules, which train and run everywhere, and the
layers' plans for a frozen trunk on a CPU (`lay_out_for_inference`).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.compact.inference import Planned, plain_path

Turn = tuple[Tensor, Tensor] | Tensor  # cosines and sines, or what a plan turns by


class Cache:
    """Keys and values of every layer in fixed buffers (layers, 2, B, A, capacity, C), and how many slots are valid."""

    def __init__(self, layers: int, batch: int, heads: int, capacity: int, channels: int, like: Tensor) -> None:
        self.buffer = like.new_zeros((layers, 2, batch, heads, capacity, channels))
        self.layers = list(self.buffer)  # (2, B, A, capacity, C): keys, values
        self.capacity = capacity
        self.length = 0

    def keep(self, start: int, path: Tensor) -> None:
        """Commit: move the entries at slots `path` (n,) to start, start + 1, …; whatever lay behind them is dropped.

        `path` is increasing and starts at or after `start`, so the copy reads only what it has not overwritten.
        """
        n = path.shape[0]
        self.buffer[..., start : start + n, :] = self.buffer.index_select(-2, path)
        self.length = start + n


class Rotary(Planned):
    """Rotary position embedding, half-split layout; tables are computed once in float32."""

    cos: Tensor
    sin: Tensor

    def __init__(self, channels: int, positions: int = 1024, base: float = 10_000.0) -> None:
        super().__init__()
        frequencies = base ** (-torch.arange(0, channels, 2, dtype=torch.float32) / channels)
        angles = torch.arange(positions, dtype=torch.float32)[:, None] * frequencies
        self.register_buffer("cos", torch.cat([angles.cos(), angles.cos()], -1), persistent=False)
        # the sign of the swapped half is folded into the table: x·cos + swap(x)·sin
        self.register_buffer("sin", torch.cat([-angles.sin(), angles.sin()], -1), persistent=False)

    def forward(self, positions: Tensor) -> Turn:
        """positions (T,) -> cos, sin (T, 1, C), to be reused by every layer; with a plan what its layers take."""
        if self.plan is not None:
            return self.plan(positions)
        return self.cos[positions][:, None], self.sin[positions][:, None]


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """x (B, T, heads, C) turned by its position."""
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)


def cosines_and_sines(turn: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    """A plan's complex numbers as `Rotary` gives them without one."""
    turn = turn[:, None, : channels // 2]
    return torch.cat([turn.real, turn.real], -1), torch.cat([-turn.imag, turn.imag], -1)


class Layer(Planned):
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
        rotary: Turn,
        cache: Tensor | None = None,
        start: int = 0,
        mask: Tensor | None = None,
    ) -> Tensor:
        """x (B, T, E); mask (T, S + T) additive, or None for plain causal attention (T = 1 needs none).

        cache (2, B, A, capacity, C) holds keys as this layer's path writes them: one path per cache.
        """
        if isinstance(rotary, Tensor):
            if self.plan is not None and not plain_path(x):
                return self.plan(x, rotary, cache, start, mask)
            rotary = cosines_and_sines(rotary, self.channels)
        batch, tokens, width = x.shape
        qkv = self.qkv(self.attention_norm(x)).view(batch, tokens, 3 * self.heads, self.channels)
        qk = rotate(qkv[:, :, : 2 * self.heads], *rotary)
        q = qk[:, :, : self.heads].transpose(1, 2)
        k = qk[:, :, self.heads :].transpose(1, 2)
        v = qkv[:, :, 2 * self.heads :].transpose(1, 2)
        causal = mask is None and tokens > 1
        if cache is not None:
            end = start + tokens
            cache[0][:, :, start:end] = k
            cache[1][:, :, start:end] = v
            if start:
                k, v = cache[0][:, :, :end], cache[1][:, :, :end]
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=causal)
        x = x + self.out(attended.transpose(1, 2).reshape(batch, tokens, width))
        gate, up = self.gate_up(self.feed_norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)


class Trunk(Planned):
    """Layers and the final norm. Its output is the hidden state that the head and the drafter read."""

    def __init__(self, width: int, layers: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.width, self.heads = width, heads
        self.rotary = Rotary(width // heads)
        self.layers = nn.ModuleList(Layer(width, heads, feed_forward) for _ in range(layers))
        self.norm = nn.RMSNorm(width, eps=1e-5)
        for name, parameter in self.named_parameters():
            if parameter.dim() == 2:
                nn.init.normal_(parameter, std=0.02)
                if name.endswith(("out.weight", "down.weight")):
                    parameter.data /= (2 * layers) ** 0.5

    def new_cache(self, batch: int, capacity: int) -> Cache:
        like = self.norm.weight
        return Cache(len(self.layers), batch, self.heads, capacity, self.width // self.heads, like)

    def forward(self, x: Tensor, positions: Tensor, cache: Cache | None = None, mask: Tensor | None = None) -> Tensor:
        """Hidden states (B, T, E) of the new tokens x (B, T, E) at rotary `positions` (T,).

        With a cache the keys and values are written behind the valid ones (`cache.length` grows by T); mask
        (T, length + T) is additive and says which cached and new tokens each new token sees. Without a mask attention
        is causal, which with a non-empty cache is only defined for T = 1.
        """
        rotary = self.rotary(positions)
        start = cache.length if cache is not None else 0
        if mask is None and start and x.shape[1] > 1:
            raise ValueError("several tokens behind a cached prefix need a mask")
        for i, layer in enumerate(self.layers):
            x = layer(x, rotary, cache.layers[i] if cache is not None else None, start, mask)
        if cache is not None:
            cache.length = start + x.shape[1]
        return self.norm(x) if self.plan is None or plain_path(x) else self.plan(x)
