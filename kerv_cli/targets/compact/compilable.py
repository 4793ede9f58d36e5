"""Modules that can be compiled for a CPU, and `compile_parts`, which compiles them when their weights are final."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import torch
from torch import Tensor, nn

from kerv_cli.targets.checkpoint import load_state
from kerv_cli.targets.compact.program import Program, forget

M = TypeVar("M", bound=nn.Module)
FORMATS = torch.float32, torch.bfloat16
"""Number formats of weights that can be compiled."""


def wants_gradient(x: Tensor) -> bool:
    """Return whether gradients of `x` are needed. Compiled modules give no gradients, so torch must then compute."""
    return x.requires_grad and torch.is_grad_enabled()


class Compilable(nn.Module):
    """A module that can be compiled for a CPU while its weights are frozen.

    Moving the module, loading weights into it or unfreezing it discards the compiled form, and torch computes as usual.
    After changing weights in any other way (`parameter.data`, a submodule's own `load_state_dict`), call
    `compile_parts` again.

    Attributes:
        compiled: The compiled form. None if the module is not compiled.
    """

    compiled: Any = None

    def new_program(self) -> Any:
        """Return the compiled form of this module, for `compile_parts`. None if the module cannot be compiled."""
        return None

    def runs_compiled(self, x: Tensor) -> bool:
        """Return whether to use the compiled form for `x`: True if it exists and no gradients are needed."""
        return self.compiled is not None and isinstance(x, Tensor) and not wants_gradient(x)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.compiled = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *arguments: Any, **keywords: Any) -> None:
        self.compiled = None
        super()._load_from_state_dict(*arguments, **keywords)

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Freeze or unfreeze all parameters. Unfreezing discards the compiled form of every submodule, too."""
        for part in self.modules():
            if requires_grad and isinstance(part, Compilable):
                part.compiled = None
        return super().requires_grad_(requires_grad)


class CompilableLinear(Compilable, nn.Linear):
    """A linear layer that is compiled by itself, not as a part of a larger module. An example is an output head."""

    def new_program(self) -> Any:
        """Return the compiled layer, a `Program`. None if no compiled kernels exist for the weights' number format."""
        return Program(super().forward, (1, self.in_features)) if self.weight.dtype in FORMATS else None

    def forward(self, x: Tensor) -> Tensor:
        """Map inputs (…, in_features) to outputs (…, out_features). The compiled form returns float32."""
        return self.compiled(x)[0].view(*x.shape[:-1], -1) if self.runs_compiled(x) else super().forward(x)


def compile_parts(module: nn.Module) -> None:
    """Compile every `Compilable` submodule of a module, and store the compiled form in its `compiled`.

    Nothing happens unless all parameters are frozen, on a CPU and in one number format.
    """
    parameters = list(module.parameters())
    if all(p.device.type == "cpu" and p.dtype == parameters[0].dtype and not p.requires_grad for p in parameters):
        forget(module)
        parts = [part for part in module.modules() if isinstance(part, Compilable)]
        for part in parts:
            part.compiled = None
        for part in parts:
            part.compiled = part.new_program()


def load_compiled(module: M, folder: Path, kind: str, device: str | torch.device, dtype: torch.dtype) -> M:
    """Load the weights in a folder into a module. Move it to a device, freeze it, and on a CPU compile it.

    Args:
        module: A module with the shapes of the stored weights.
        folder: Folder with `model.safetensors`.
        kind: Kind of artifact, such as `drafter`, for error messages.
        device: Device to move the module to.
        dtype: Number format to convert the weights to.

    Raises:
        CheckpointError: The weights are missing, damaged, or do not fit the module.
    """
    load_state(module, folder, kind)
    module = module.to(device=device, dtype=dtype).eval().requires_grad_(False)
    compile_parts(module)
    return module
