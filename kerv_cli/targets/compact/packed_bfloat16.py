"""Packed weights of a frozen bfloat16 stack on a CPU that multiplies bfloat16 in hardware (AMX, AVX512-BF16).

Each weight lies in oneDNN's blocked layout, where one row and thirty cost almost the same: the weights' bytes are what
takes time. The residual stream, norms, rotations, attention and the cache are float32: they cost little, and rounding
them would make near ties of the argmax more frequent. oneDNN sums in another order for one row than for many, so that
the last bit of a bfloat16 product depends on the number of rows; `kerv bench` counts the tokens that this changes.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.attention import Cache
from kerv_cli.targets.compact.kernels import RowNorm, gain_of, has_blocked_layouts, with_pairs
from kerv_cli.targets.compact.trunk import Layer, PackedStack, Rotary

ROWS = 32  # for which the layout is chosen; measured, 154 M weights: one row 27 ms, 31 rows 33 ms, 47 rows 41 ms


@lru_cache(maxsize=1)
def multiplies_bfloat16() -> bool:
    """Whether this CPU has products of bfloat16, and this build of torch the layouts for them."""
    supported = torch.ops.mkldnn._is_mkldnn_bf16_supported() if has_blocked_layouts() else False
    return bool(supported) and (has_tiles() or torch.cpu._is_avx512_bf16_supported())


def has_tiles() -> bool:
    """Whether this CPU multiplies tiles of bfloat16 (AMX)."""
    return bool(torch.cpu._is_amx_tile_supported())


class BlockedLinear:
    """x (n, I) bfloat16 -> (n, O) bfloat16 with a weight (O, I), sums in float32."""

    def __init__(self, weight: Tensor) -> None:
        self.blocked = torch.ops.mkldnn._reorder_linear_weight(weight.to(torch.bfloat16).contiguous(), ROWS)

    def __call__(self, x: Tensor) -> Tensor:
        return torch.ops.mkldnn._linear_pointwise(x, self.blocked, None, "none", [], "")


class BlockedLayer:
    """Packed weights of a decoder layer; the halves that RoPE rotates lie side by side, see `with_pairs`."""

    def __init__(self, layer: Layer) -> None:
        self.heads, self.channels = layer.heads, layer.channels
        self.width = layer.heads * layer.channels
        self.norm = RowNorm(layer.attention_norm)
        qkv = layer.qkv.weight.float() * gain_of(layer.attention_norm)
        self.qkv = BlockedLinear(with_pairs(qkv, self.channels))
        self.out = BlockedLinear(layer.out.weight)
        self.gate_up = BlockedLinear(layer.gate_up.weight.float() * gain_of(layer.feed_norm))
        self.down = BlockedLinear(layer.down.weight)

    def __call__(self, rows: Tensor, turn: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """rows (B, T, E) float32, changed in place; turn (T, 1, C / 2) complex; cache (2, B, A, capacity, C) float32,
        valid up to `start`; mask (T, start + T)."""
        batch, tokens, width = rows.shape
        if batch * tokens == 1:
            return self.step(rows, turn, cache, start, mask)
        qkv = self.qkv(self.norm(rows).view(-1, width).to(torch.bfloat16)).float()
        heads = qkv.view(batch, tokens, 3 * self.heads, self.channels)
        torch.view_as_complex(heads[:, :, : 2 * self.heads].unflatten(-1, (-1, 2))).mul_(turn)
        q, k, v = heads.unflatten(2, (3, -1)).permute(2, 0, 3, 1, 4)
        if cache is not None:
            cache[0].narrow(2, start, tokens).copy_(k)
            cache[1].narrow(2, start, tokens).copy_(v)
            k, v = cache.narrow(3, 0, start + tokens)
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=mask is None and tokens > 1)
        flat = rows.view(-1, width)
        flat += self.out(attended.transpose(1, 2).reshape(-1, width).to(torch.bfloat16))
        gate, up = self.gate_up(self.norm(flat).to(torch.bfloat16)).chunk(2, -1)
        flat += self.down(F.silu(gate).mul_(up))
        return rows

    def step(self, rows: Tensor, turn: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """`__call__` for one token of one sequence, with fewer calls: behind cold caches each takes 10 µs."""
        row = rows.view(self.width)
        qkv = self.qkv(self.normed(row)).float().view(3, 1, self.heads, 1, self.channels)
        torch.view_as_complex(qkv[:2].unflatten(-1, (-1, 2))).mul_(turn)
        q, k, v = qkv
        if cache is not None:
            cache.narrow(3, start, 1).copy_(qkv[1:])
            k, v = cache.narrow(3, 0, start + 1)
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        rows.add_(self.out(attended.view(1, self.width).to(torch.bfloat16)))
        gate, up = self.gate_up(self.normed(row)).chunk(2, -1)
        return rows.add_(self.down(F.silu(gate).mul_(up)))

    def normed(self, row: Tensor) -> Tensor:
        """row (E,) float32 -> its norm without the gain, (1, E) bfloat16."""
        return row.mul(self.norm.of_vector(row)).to(torch.bfloat16)[None]


class BlockedLayers(PackedStack):
    """Packed weights of a stack's layers and its final norm. Its caches are float32."""

    cache_dtype = torch.float32

    def __init__(self, rotary: Rotary, layers: Iterable[Layer], norm: nn.RMSNorm) -> None:
        """layers: read one by one, so that a generator never holds two of them."""
        half = rotary.cos.shape[-1] // 2
        self.turns = torch.complex(rotary.cos[:, :half].float(), rotary.sin[:, half:].float())[:, None]
        self.layers = [BlockedLayer(layer) for layer in layers]
        self.rows, self.gain = RowNorm(norm), gain_of(norm)

    def __call__(self, x: Tensor, positions: Tensor, cache: Cache | None, mask: Tensor | None) -> Tensor:
        """All layers: x (B, T, E) bfloat16 -> hidden states (B, T, E), before the norm."""
        rows = x.to(torch.float32, memory_format=torch.contiguous_format, copy=True)
        turn = self.turns.index_select(0, positions)
        start = cache.length if cache is not None else 0
        mask = None if mask is None else mask.float()
        for i, layer in enumerate(self.layers):
            rows = layer(rows, turn, cache.layers[i] if cache is not None else None, start, mask)
        return rows.to(torch.bfloat16)

    def norm(self, x: Tensor) -> Tensor:
        """The final RMSNorm with its gain."""
        return self.rows(x.float()).mul_(self.gain).to(torch.bfloat16)
