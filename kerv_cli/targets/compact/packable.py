"""Modules that have a compiled form on a CPU, and `pack`, which makes it once their weights are final."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import torch
from torch import Tensor, nn

from kerv_cli.targets.checkpoint import load_state
from kerv_cli.targets.compact.program import Program, forget

M = TypeVar("M", bound=nn.Module)


def wants_gradient(x: Tensor) -> bool:
    """Whether x needs gradients, which compiled forms do not have: then the modules compute."""
    return x.requires_grad and torch.is_grad_enabled()


class Packable(nn.Module):
    """A module that can have a compiled form, `packed`, for frozen weights on a CPU.

    Moving it, loading weights, unfreezing or training it drops the compiled form; then the module computes. After
    writing weights in another way (`parameter.data`, a part's own `load_state_dict`) call `pack` again.
    """

    packed: Any = None

    def pack_weights(self) -> Any:
        """Return the compiled form of this module, whose weights are frozen on a CPU; None if there is none."""
        return None

    def is_packed(self, x: Tensor) -> bool:
        """Whether the compiled form computes x: not if gradients are wanted."""
        return self.packed is not None and isinstance(x, Tensor) and not wants_gradient(x)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.packed = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *arguments: Any, **keywords: Any) -> None:
        self.packed = None
        super()._load_from_state_dict(*arguments, **keywords)

    def train(self, mode: bool = True) -> Self:
        """Set the mode of `nn.Module.train`; training mode drops the compiled form."""
        if mode:
            self.packed = None
        return super().train(mode)

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Freeze or unfreeze all parameters; unfreezing drops the compiled form of all parts."""
        for part in self.modules():
            if requires_grad and isinstance(part, Packable):
                part.packed = None
        return super().requires_grad_(requires_grad)


class PackableLinear(Packable, nn.Linear):
    """A linear layer that is called on its own, such as a head."""

    def pack_weights(self) -> Any:
        """Return the compiled product of a float32 layer."""
        return Program(super().forward, (1, self.in_features)) if self.weight.dtype == torch.float32 else None

    def forward(self, x: Tensor) -> Tensor:
        """x (…, I) -> (…, O)."""
        return self.packed(x)[0].view(*x.shape[:-1], -1) if self.is_packed(x) else super().forward(x)


def pack(module: nn.Module) -> None:
    """Compile the parts of a module that support it, if all its parameters are frozen on a CPU and of one format."""
    parameters = list(module.parameters())
    if all(p.device.type == "cpu" and p.dtype == parameters[0].dtype and not p.requires_grad for p in parameters):
        forget(module)
        parts = [part for part in module.modules() if isinstance(part, Packable)]
        for part in parts:
            part.packed = None
        for part in parts:
            part.packed = part.pack_weights()


def load_packed(module: M, folder: Path, kind: str, device: str | torch.device, dtype: torch.dtype) -> M:
    """Load the weights in a folder into a module, move it to its device, freeze and compile it.

    Raises:
        CheckpointError: As `load_state`.
    """
    load_state(module, folder, kind)
    module = module.to(device=device, dtype=dtype).eval().requires_grad_(False)
    pack(module)
    return module
