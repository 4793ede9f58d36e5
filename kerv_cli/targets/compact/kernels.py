"""Products and norms of packed weights on a CPU: the same numbers in the layout that is fastest there;
oneDNN's blocked one halves the time of 30 rows."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

BLOCKED_FROM = 600_000  # multiplications below which a plain product beats oneDNN's call overhead of 15 µs (measured)


def has_blocked_layouts() -> bool:
    """Whether this build of torch carries oneDNN's fused products."""
    names = ("_linear_pointwise", "_reorder_linear_weight")
    return torch.backends.mkldnn.is_available() and all(hasattr(torch.ops.mkldnn, name) for name in names)


def row_product(weight: np.ndarray, x: np.ndarray) -> np.ndarray:
    """weight (O, I), x (I,) -> (O,), by numpy's BLAS."""
    return np.dot(weight, x)


class FastLinear:
    """x (n, I) -> (n, O) with a weight (O, I): as it is for a few rows, in oneDNN's blocks for many. A single row goes
    through `row_product` of `array`: with MKL, which torch is built with, its products take twice as long on some CPUs
    (measured on an AMD EPYC, one token of `small`: 1.7 ms against 0.8 ms)."""

    def __init__(self, weight: Tensor) -> None:
        self.weight = weight.contiguous()
        self.array: np.ndarray = self.weight.numpy()
        self.rows = -(-BLOCKED_FROM // weight.numel())
        self.blocked: Tensor | None = None
        if has_blocked_layouts():
            self.blocked = torch.ops.mkldnn._reorder_linear_weight(self.weight, 32)

    def __call__(self, x: Tensor) -> Tensor:
        if self.blocked is not None and x.shape[0] >= self.rows:
            return torch.ops.mkldnn._linear_pointwise(x, self.blocked, None, "none", [], "")
        return torch.mm(x, self.weight.t())

    def added_to(self, other: Tensor, x: Tensor) -> Tensor:
        """other (n, O) + the product."""
        if self.blocked is not None and x.shape[0] >= self.rows:
            return torch.ops.mkldnn._linear_pointwise.binary(x, other, self.blocked, None, "add")
        return torch.addmm(other, x, self.weight.t())


class RowNorm:
    """x / √(Σ x² + E ε): RMSNorm without its gain and √E, which are folded into the next weight."""

    def __init__(self, norm: nn.RMSNorm) -> None:
        self.width_eps = norm.weight.shape[0] * (norm.eps or 0.0)
        self.floor = torch.tensor(math.sqrt(self.width_eps))

    def __call__(self, x: Tensor) -> Tensor:
        return x / torch.hypot(torch.linalg.vector_norm(x, 2, -1, True), self.floor)

    def of_vector(self, x: Tensor) -> float:
        """The factor for a single row (E,)."""
        return 1.0 / math.sqrt(float(torch.dot(x, x)) + self.width_eps)


def gain_of(norm: nn.RMSNorm) -> Tensor:
    """The factor (E,) that `RowNorm` leaves out, gain · √E, in float32."""
    return norm.weight.float() * norm.weight.shape[0] ** 0.5


def with_pairs(qkv: Tensor, channels: int) -> Tensor:
    """qkv (3 E, I), heads of C = `channels` -> the same with each two numbers that RoPE rotates, of queries and keys,
    side by side."""
    width = qkv.shape[0] // 3
    pairs = torch.arange(channels).view(2, -1).t().flatten()
    qk = qkv[: 2 * width].unflatten(0, (-1, channels))[:, pairs].flatten(0, 1)
    return torch.cat([qk, qkv[2 * width :]])
