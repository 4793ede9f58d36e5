"""What a frozen module keeps for fast CPU inference: a plan, made once from its weights by `lay_out_for_inference`.

A plan holds the same numbers in other layouts (oneDNN's blocked one, which halves the time of 30 tokens; input-major
for a single token) and with what is linear folded together: a norm's gain or a temperature into the weights behind it.
It is no part of the state: a copy, a pickle, another device, other weights or training go without one, on the modules'
own path.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor, nn

BLOCKED_FROM = 600_000  # multiplications below which a plain product beats oneDNN's call overhead of 15 µs (measured)


def has_blocked_layouts() -> bool:
    """Whether this build of torch carries oneDNN's fused operators."""
    names = ("_linear_pointwise", "_convolution_pointwise", "_reorder_linear_weight", "_reorder_convolution_weight")
    return torch.backends.mkldnn.is_available() and all(hasattr(torch.ops.mkldnn, name) for name in names)


def frozen_on_cpu(module: nn.Module) -> bool:
    """float32 on a CPU and nothing to train: the modules that a plan is for."""
    return all(p.device.type == "cpu" and p.dtype == torch.float32 and not p.requires_grad for p in module.parameters())


class Plan:
    """Copies and pickles as None: what is derived travels with nobody, and oneDNN's layouts could not."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()


class Planned(nn.Module):
    """A module that may have a plan. Moving it, loading weights, unfreezing or training it drops the plan; weights
    written past these (`parameter.data`) need another `lay_out_for_inference`."""

    plan: Any = None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.plan = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *arguments: Any, **keywords: Any) -> None:
        self.plan = None
        super()._load_from_state_dict(*arguments, **keywords)

    def train(self, mode: bool = True) -> Self:
        if mode:
            self.plan = None
        return super().train(mode)

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        for part in self.modules():
            if requires_grad and isinstance(part, Planned):
                part.plan = None
        return super().requires_grad_(requires_grad)


def plain_path(x: Tensor) -> bool:
    """Plans know no gradients: an input that wants one takes the modules."""
    return x.requires_grad and torch.is_grad_enabled()


class FastLinear:
    """x (n, I) -> (n, O) with a weight (O, I): input-major for a few rows, oneDNN's blocks for many."""

    def __init__(self, weight: Tensor) -> None:
        self.input_major = weight.t().contiguous()
        self.weight = self.input_major.t()
        self.nothing = weight.new_zeros(1)
        self.rows = -(-BLOCKED_FROM // weight.numel())
        self.blocked: Tensor | None = None
        if has_blocked_layouts():
            self.blocked = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous(), 32)

    def __call__(self, x: Tensor) -> Tensor:
        if self.blocked is not None and x.shape[0] >= self.rows:
            return torch.ops.mkldnn._linear_pointwise(x, self.blocked, None, "none", [], "")
        return torch.mm(x, self.input_major)

    def added_to(self, other: Tensor, x: Tensor) -> Tensor:
        """other (n, O) + the product."""
        if self.blocked is not None and x.shape[0] >= self.rows:
            return torch.ops.mkldnn._linear_pointwise.binary(x, other, self.blocked, None, "add")
        return torch.addmm(other, x, self.input_major)

    def of_vector(self, x: Tensor, scale: float) -> Tensor:
        """x (I,) -> scale · the product (O,)."""
        return torch.addmv(self.nothing, self.weight, x, beta=0, alpha=scale)


class FastConv:
    """A convolution on channels-last maps of one fixed size, weight blocked once; `pointwise` follows it for free."""

    def __init__(self, conv: nn.Conv2d, size: int, weight: Tensor | None = None, bias: Tensor | None = None) -> None:
        weight = conv.weight if weight is None else weight
        self.bias = conv.bias if bias is None else bias
        self.geometry = (list(conv.padding), list(conv.stride), list(conv.dilation), conv.groups)
        self.weight = torch.ops.mkldnn._reorder_convolution_weight(
            weight.contiguous(memory_format=torch.channels_last), *self.geometry, [1, conv.in_channels, size, size]
        )

    def __call__(self, x: Tensor, pointwise: str = "none") -> Tensor:
        return torch.ops.mkldnn._convolution_pointwise(x, self.weight, self.bias, *self.geometry, pointwise, [], "")

    def added_to(self, other: Tensor, x: Tensor) -> Tensor:
        """other += the convolution, in place."""
        return torch.ops.mkldnn._convolution_pointwise_.binary(
            other, x, self.weight, self.bias, *self.geometry, "add", 1.0, None, [], None
        )
