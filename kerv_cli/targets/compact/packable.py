"""The bases of packed weights and of modules that can have them; `packed.py` makes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor, nn


def wants_gradient(x: Tensor) -> bool:
    """Whether x needs gradients, which packed weights do not have: then the modules compute."""
    return x.requires_grad and torch.is_grad_enabled()


class Packed:
    """Base of packed weights. Copies and pickles as None, because oneDNN's layouts can be neither copied nor
    pickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()


class Packable(nn.Module):
    """A module that can have packed weights. Moving it, loading weights, unfreezing or training it drops them. After
    writing weights in another way (`parameter.data`, a part's own `load_state_dict`) call `pack` again."""

    packed: Any = None

    def pack_weights(self) -> Packed | None:
        """Packed weights of this module, which is frozen on a CPU; None where they would not be faster. `pack` calls it
        for types that `packed_weights` does not name."""
        return None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.packed = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *arguments: Any, **keywords: Any) -> None:
        self.packed = None
        super()._load_from_state_dict(*arguments, **keywords)

    def train(self, mode: bool = True) -> Self:
        """Sets the mode of `nn.Module.train`; training mode drops the packed weights."""
        if mode:
            self.packed = None
        return super().train(mode)

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Freezes or unfreezes all parameters; unfreezing drops the packed weights of all parts."""
        for part in self.modules():
            if requires_grad and isinstance(part, Packable):
                part.packed = None
        return super().requires_grad_(requires_grad)
