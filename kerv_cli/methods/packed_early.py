"""Packed weights of a frozen early drafter on a CPU: one observation at a time, with few calls.

Standardisation and the norms' gains are folded into the weights behind them, as in `targets/compact/packed.py`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch.nn.functional as F
from torch import Tensor

from kerv_cli.targets.compact.kernels import FastLinear, RowNorm, gain_of
from kerv_cli.targets.compact.packable import Packed

if TYPE_CHECKING:
    from kerv_cli.methods.early import Block, EarlyDrafter


class PackedBlock:
    """Packed weights of a residual SwiGLU block."""

    def __init__(self, block: Block) -> None:
        self.norm = RowNorm(block.norm)
        self.gate_up, self.gate_up_bias = FastLinear(block.gate_up.weight * gain_of(block.norm)), block.gate_up.bias
        self.down, self.down_bias = FastLinear(block.down.weight), block.down.bias

    def __call__(self, x: Tensor) -> Tensor:
        """(W,), changed in place -> (W,)."""
        gate, up = self.gate_up.of_vector(x, self.norm.of_vector(x)).add_(self.gate_up_bias).chunk(2)
        x += self.down_bias
        return self.down.added_to_vector(x, F.silu(gate).mul_(up))


class PackedEarly(Packed):
    """Packed weights of `EarlyDrafter.forward` for one observation."""

    def __init__(self, early: EarlyDrafter) -> None:
        weight, features = early.enter.weight.clone(), len(early.mean)
        weight[:, :features] *= early.scale
        self.enter = FastLinear(weight)
        self.enter_bias = early.enter.bias - weight[:, :features] @ early.mean
        blocks: Any = early.blocks
        self.blocks = [PackedBlock(block) for block in blocks]
        self.norm = RowNorm(early.norm)
        self.spread, self.spread_bias = FastLinear(early.spread.weight * gain_of(early.norm)), early.spread.bias
        self.head, self.head_bias = FastLinear(early.head.weight), early.head.bias
        self.shape = early.tokens, early.settings.rank

    def __call__(self, shown: Tensor) -> Tensor:
        """shown (F + h (D + 1),): pooled prompt, past actions and which of them are known -> logits (N, V)."""
        x = self.enter.added_to_vector(self.enter_bias, shown)
        for block in self.blocks:
            x = block(x)
        spread = self.spread.of_vector(x, self.norm.of_vector(x)).add_(self.spread_bias)
        return self.head(spread.view(self.shape)).add_(self.head_bias)
