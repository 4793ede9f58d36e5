"""The trunk's layers on a frozen CPU model: few calls, no copies that a product does not need.

At these widths half of a one-token forward goes into calls, the other half into reading the weights. So a layer has as
few calls as possible: a norm is one number per row (its gain is folded into the next weight), the two halves that RoPE
turns lie side by side and are turned as complex numbers in place, keys and values are written together, and the product
adds the residual.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.compact.inference import FastLinear, Plan
from kerv_cli.targets.compact.trunk import Layer, Rotary

EXPLICIT = range(24, 513)  # query tokens for which three plain calls beat the fused attention of a CPU (measured)


@lru_cache(maxsize=128)
def causal_mask(tokens: int) -> Tensor:
    """Additive (T, T)."""
    with torch.inference_mode(False):
        return torch.full((tokens, tokens), -torch.inf).triu(1)


class RotaryPlan(Plan):
    """Unit complex numbers for [q, k, v] with neighbouring pairs; v is turned by nothing."""

    def __init__(self, rotary: Rotary, heads: int) -> None:
        half = rotary.cos.shape[-1] // 2
        turn = torch.complex(rotary.cos[:, :half], rotary.sin[:, half:])
        turns = torch.cat([turn.repeat(1, 2 * heads), torch.ones_like(turn).repeat(1, heads)], -1)
        self.table = torch.view_as_real(turns).flatten(1)  # float rows are gathered faster

    def __call__(self, positions: Tensor) -> Tensor:
        """positions (T,) -> (T, 3 A C / 2) complex64."""
        return self.table.index_select(0, positions).view(torch.complex64)


class RowNorm:
    """x / √(Σ x² + E ε): RMSNorm without its gain and √E, which the next weight has taken."""

    def __init__(self, width: int, eps: float) -> None:
        self.width_eps = width * eps
        self.floor = torch.tensor(math.sqrt(self.width_eps))

    def __call__(self, x: Tensor) -> Tensor:
        return x / torch.hypot(torch.linalg.vector_norm(x, 2, -1, True), self.floor)

    def of_vector(self, x: Tensor) -> float:
        """The factor for a single row (E,)."""
        return 1.0 / math.sqrt(float(torch.dot(x, x)) + self.width_eps)


class NormPlan(Plan):
    """RMSNorm with its gain: the trunk's last."""

    def __init__(self, norm: nn.RMSNorm) -> None:
        width = norm.weight.shape[0]
        self.rows = RowNorm(width, norm.eps or 0.0)
        self.gain = norm.weight * width**0.5

    def __call__(self, x: Tensor) -> Tensor:
        return self.rows(x).mul_(self.gain)


class LayerPlan(Plan):
    def __init__(self, layer: Layer) -> None:
        self.heads, self.channels = layer.heads, layer.channels
        width = self.width = layer.heads * layer.channels
        self.scale = layer.channels**-0.5
        self.norm = RowNorm(width, layer.attention_norm.eps or 0.0)
        qkv = layer.qkv.weight * (layer.attention_norm.weight * width**0.5)
        pairs = torch.arange(self.channels).view(2, -1).t().flatten()
        qk = qkv[: 2 * width].view(2 * self.heads, self.channels, width)[:, pairs].reshape(2 * width, width)
        self.qkv = FastLinear(torch.cat([qk, qkv[2 * width :]]))
        self.out = FastLinear(layer.out.weight)
        self.gate_up = FastLinear(layer.gate_up.weight * (layer.feed_norm.weight * width**0.5))
        self.down = FastLinear(layer.down.weight)

    def __call__(self, x: Tensor, turn: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """As `Layer.forward`; turn (T, 3 A C / 2) from `RotaryPlan`. The cache holds keys with neighbouring pairs."""
        batch, tokens, width = x.shape
        if batch * tokens == 1:
            return self.step(x, turn, cache, start, mask)
        rows = x.reshape(-1, width)
        qkv = self.qkv(self.norm(rows))
        qkv.view(torch.complex64).view(batch, tokens, -1).mul_(turn)
        attended = self.attend(qkv.view(batch, tokens, 3, self.heads, self.channels), cache, start, mask)
        rows = self.out.added_to(rows, attended)
        gate, up = self.gate_up(self.norm(rows)).chunk(2, -1)
        return self.down.added_to(rows, F.silu(gate).mul_(up)).view(batch, tokens, width)

    def attend(self, qkv: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """qkv (B, T, 3, A, C), turned -> (B T, E)."""
        batch, tokens = qkv.shape[:2]
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        if cache is not None:
            cache.narrow(3, start, tokens).copy_(qkv[:, :, 1:].permute(2, 0, 3, 1, 4))
            k, v = cache.narrow(3, 0, start + tokens)
        if batch == 1 and tokens in EXPLICIT:
            if mask is None:
                mask = causal_mask(tokens)
            scores = torch.baddbmm(mask, q[0], k[0].transpose(1, 2), alpha=self.scale)
            return torch.bmm(scores.softmax(-1), v[0]).transpose(0, 1).reshape(tokens, self.width)
        causal = mask is None and tokens > 1
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=causal)
        return attended.transpose(1, 2).reshape(batch * tokens, self.width)

    def step(self, x: Tensor, turn: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """One token of one sequence, as a vector."""
        row = x.reshape(self.width)
        qkv = self.qkv.of_vector(row, self.norm.of_vector(row))
        qkv.view(torch.complex64).mul_(turn.view(-1))
        q, k, v = heads = qkv.view(3, 1, self.heads, 1, self.channels)
        if cache is not None:
            cache.narrow(3, start, 1).copy_(heads[1:])
            k, v = cache.narrow(3, 0, start + 1)
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        row = torch.addmv(row, self.out.weight, attended.view(self.width))
        gate, up = self.gate_up.of_vector(row, self.norm.of_vector(row)).view(2, -1)
        return row.addmv_(self.down.weight, F.silu(gate).mul_(up)).view(1, 1, self.width)
