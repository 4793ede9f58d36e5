"""Decoder layers in bfloat16 on a CPU that multiplies it in hardware (AMX, AVX512-BF16).

Weights are stored in the blocked layout of oneDNN, the library that torch uses for matrix multiplications on a CPU. One
row and thirty rows then take almost the same time, because most of the time is spent on reading the weights. The
residual stream, norms, rotations, attention and the cache stay float32. They are cheap, and rounding them would more
often make the two best logits almost equal. oneDNN adds in a different order for one row than for many, so the last bit
of a result depends on the number of rows (docs/measuring.md).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

ROWS = 32  # oneDNN chooses the layout for this many rows; 154 M weights take 27 ms for 1 row, 33 for 31, 41 for 47


@lru_cache(maxsize=1)
def multiplies_bfloat16() -> bool:
    """Return whether this CPU and this build of torch can multiply bfloat16 matrices in blocked layout."""
    supported = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return bool(supported) and (has_tiles() or torch.cpu._is_avx512_bf16_supported())


def has_tiles() -> bool:
    """Return whether this CPU has AMX, instructions that multiply bfloat16 tiles."""
    return bool(torch.cpu._is_amx_tile_supported())


class BlockedLinear(nn.Module):
    """A linear layer without bias, whose weight is bfloat16 in oneDNN's blocked layout. Sums are float32.

    Args:
        weight: (outputs, inputs).
    """

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.blocked = torch.ops.mkldnn._reorder_linear_weight(weight.to(torch.bfloat16).contiguous(), ROWS)

    def forward(self, x: Tensor) -> Tensor:
        """Map inputs (…, inputs) to outputs (…, outputs) in the number format of `x`."""
        product = torch.ops.mkldnn._linear_pointwise(x.to(torch.bfloat16), self.blocked, None, "none", [], "")
        return product.to(x.dtype)


def blocked(layer: nn.Module) -> nn.Module:
    """Return a copy of a decoder layer with blocked bfloat16 weights (see `BlockedLinear`) and float32 norms."""
    twin = copy.copy(layer)
    twin._modules = {
        name: BlockedLinear(part.weight) if isinstance(part, nn.Linear) else copy.deepcopy(part).float()
        for name, part in layer.named_children()
    }
    return twin


class Bfloat16Layers:
    """Decoder layers with blocked bfloat16 weights and a float32 cache.

    A copied or pickled module holds None instead of this object, because oneDNN's layout cannot be copied.
    """

    def __init__(self, rotary: tuple[Tensor, Tensor], layers: Iterable[nn.Module]) -> None:
        """Convert layers one after the other.

        Args:
            rotary: Cosines and sines of all positions.
            layers: Decoder layers. A generator saves memory: only one unconverted layer exists at a time.
        """
        self.rotary = [table.float() for table in rotary]
        self.layers = [blocked(layer) for layer in layers]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()

    def __call__(self, x: Tensor, positions: Tensor, cache: Any, slots: Any, mask: Tensor | None) -> Tensor:
        """Return the output of the last layer for bfloat16 inputs x (B, T, E); arguments as `LayerStack.run_layers`."""
        rotary = [table[positions] for table in self.rotary]
        hidden, mask = x.float(), None if mask is None else mask.float()
        for i, layer in enumerate(self.layers):
            hidden = layer(hidden, rotary, cache.layers[i] if cache is not None else None, slots, mask)
        return hidden.to(x.dtype)
