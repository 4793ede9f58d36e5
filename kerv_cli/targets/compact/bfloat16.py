"""Decoder layers in bfloat16 on a CPU that multiplies it in hardware (AMX, AVX512-BF16).

Weights lie in oneDNN's blocked layout. One row and thirty cost almost the same there, because reading the weights takes
the time. The residual stream, norms, rotations, attention and the cache are float32: they cost little, and rounding
them would make near ties of the argmax more frequent. oneDNN sums in another order for one row than for many, so the
last bit of a product depends on the number of rows (docs/measuring.md).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

ROWS = 32  # for which the layout is chosen; measured, 154 M weights: one row 27 ms, 31 rows 33 ms, 47 rows 41 ms


@lru_cache(maxsize=1)
def multiplies_bfloat16() -> bool:
    """Whether this CPU has products of bfloat16, and this build of torch the layouts for them."""
    supported = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return bool(supported) and (has_tiles() or torch.cpu._is_avx512_bf16_supported())


def has_tiles() -> bool:
    """Whether this CPU multiplies tiles of bfloat16 (AMX)."""
    return bool(torch.cpu._is_amx_tile_supported())


class BlockedLinear(nn.Module):
    """x (…, I) -> (…, O) in the format of x, by a bfloat16 weight (O, I) in oneDNN's layout; sums in float32."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.blocked = torch.ops.mkldnn._reorder_linear_weight(weight.to(torch.bfloat16).contiguous(), ROWS)

    def forward(self, x: Tensor) -> Tensor:
        """Multiply."""
        product = torch.ops.mkldnn._linear_pointwise(x.to(torch.bfloat16), self.blocked, None, "none", [], "")
        return product.to(x.dtype)


def blocked(layer: nn.Module) -> nn.Module:
    """Return a layer with the same parts, its products blocked and its norms in float32."""
    twin = copy.copy(layer)
    twin._modules = {
        name: BlockedLinear(part.weight) if isinstance(part, nn.Linear) else copy.deepcopy(part).float()
        for name, part in layer.named_children()
    }
    return twin


class Bfloat16Layers:
    """The blocked layers of a stack, whose caches are float32. It copies and pickles as None, as oneDNN's layouts."""

    def __init__(self, rotary: tuple[Tensor, Tensor], layers: Iterable[nn.Module]) -> None:
        """Block layers one by one, so that a generator never holds two of them. rotary: cos and sin."""
        self.rotary = [table.float() for table in rotary]
        self.layers = [blocked(layer) for layer in layers]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()

    def __call__(self, x: Tensor, positions: Tensor, cache: Any, slots: Any, mask: Tensor | None) -> Tensor:
        """x (B, T, E) bfloat16 -> output of the last layer; the rest as in `LayerStack.run_layers`."""
        rotary = [table[positions] for table in self.rotary]
        hidden, mask = x.float(), None if mask is None else mask.float()
        for i, layer in enumerate(self.layers):
            hidden = layer(hidden, rotary, cache.layers[i] if cache is not None else None, slots, mask)
        return hidden.to(x.dtype)
