"""Matrices that a CPU multiplies in bfloat16 in hardware (AMX, AVX512-BF16), for the large layers of a `Program`.

Weights are stored in the blocked layout of oneDNN, the library that torch uses for matrix multiplications on a CPU. One
token and thirty tokens then take almost the same time, because most time is spent on reading the weights. All other
operations of a program are float32. They are cheap, and rounding them would more often make the two best logits almost
equal. oneDNN adds in a different order for one token than for many, so the last bit of a result depends on the number
of tokens (docs/measuring.md).
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

LARGE = 2**19
"""A bfloat16 matrix with at least this many weights is stored in oneDNN's layout. The program multiplies smaller ones
itself, because calling oneDNN would take longer than it saves."""
ROWS = 32  # oneDNN chooses the layout for this many rows; 154 M weights take 27 ms for 1 row, 33 for 31, 41 for 47


@lru_cache(maxsize=1)
def multiplies_bfloat16() -> bool:
    """Return whether this CPU and this build of torch can multiply bfloat16 matrices in blocked layout."""
    supported = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return bool(supported) and (has_tiles() or torch.cpu._is_avx512_bf16_supported())


def has_tiles() -> bool:
    """Return whether this CPU has AMX, instructions that multiply bfloat16 tiles."""
    return bool(torch.cpu._is_amx_tile_supported())


class Blocked:
    """The weights of a linear layer in bfloat16, in oneDNN's blocked layout.

    Args:
        weight: (outputs, inputs) bfloat16.
        bias: (outputs,). None means zeros.
    """

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        self.weight = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous(), ROWS)
        self.bias = None if bias is None else bias.to(torch.bfloat16)

    def __call__(self, x: Tensor) -> Tensor:
        """Map inputs (…, inputs) to outputs (…, outputs) bfloat16. The sums are computed in float32."""
        x = x.to(torch.bfloat16)
        product: Tensor = torch.ops.mkldnn._linear_pointwise(x, self.weight, self.bias, "none", [], "")
        return product
