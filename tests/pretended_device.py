"""A device that is not there: its tensors hold numbers, and it counts how often the host waits for it.

What waits is what waits on CUDA: a number or a copy that is fetched, a copy that is sent without `non_blocking`, shapes
that depend on numbers. Mixing its tensors with the host's fails, as there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")
FETCHES = ("_local_scalar_dense", "item", "equal", "is_nonzero", "allclose")
SHAPES = ("nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive")
COPIES = ("_to_copy", "to", "copy_", "cpu")


class There(Tensor):
    """A tensor of the device; `host` has its numbers."""

    host: Tensor

    @staticmethod
    def __new__(cls, host: Tensor) -> There:
        made: There = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            host.shape,
            strides=host.stride(),
            storage_offset=host.storage_offset(),
            dtype=host.dtype,
            device=DEVICE,
        )
        return made

    def __init__(self, host: Tensor) -> None:
        self.host = host

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, arguments: Any = (), keywords: Any = None) -> Any:
        raise RuntimeError(f"{function} on the device, outside of it")


class Device(TorchDispatchMode):
    """The device, while it is entered. waits: how often the host waited for it, and for what."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), keywords: Any = None) -> Any:
        keywords, name = dict(keywords or {}), function._schema.name.removeprefix("aten::")
        given = [leaf for leaf in tree_flatten((arguments, keywords))[0] if isinstance(leaf, Tensor)]
        here = [isinstance(leaf, There) for leaf in given]
        empty = any(leaf.device == DEVICE and not there for there, leaf in zip(here, given, strict=True))
        assert not empty, f"{name}: torch.tensor(…, device=…) waits, use upload"
        asked = keywords.get("device")
        sent = asked is not None and torch.device(asked) == DEVICE
        if sent:
            keywords["device"] = torch.device("cpu")
        stays = any(here) and not (asked is not None and not sent)
        if name in COPIES:
            crosses = (sent and not any(here)) or (any(here) and not stays) or (name == "copy_" and len({*here}) > 1)
            waits = crosses and not _non_blocking(function, arguments, keywords)
        else:
            mixed = any(here) and any(not there and leaf.dim() for there, leaf in zip(here, given, strict=True))
            assert not mixed, f"{name} mixes tensors of the host and of the device"
            masks = name.startswith("index") and any(leaf.dtype == torch.bool for leaf in given[1:])
            waits = any(here) and (name in FETCHES or name in SHAPES or masks)
        if waits:
            self.waits.append(name)
        found = function(*tree_map(_host, arguments), **tree_map(_host, keywords))
        return tree_map(_there, found) if sent or stays else found


def _non_blocking(function: Any, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> bool:
    place = [argument.name for argument in function._schema.arguments].index("non_blocking")
    return bool(keywords.get("non_blocking", arguments[place] if place < len(arguments) else False))


def _host(leaf: Any) -> Any:
    return leaf.host if isinstance(leaf, There) else leaf


def _there(leaf: Any) -> Any:
    return There(leaf) if isinstance(leaf, Tensor) and not isinstance(leaf, There) else leaf


def move(module: nn.Module) -> None:
    """Puts a module's weights there."""
    for part in module.modules():
        part.compiled = None  # type: ignore[assignment]
        for kept in (part._parameters, part._buffers):
            for name, tensor in kept.items():
                if tensor is not None:
                    kept[name] = There(tensor.detach())  # type: ignore[assignment]
