"""Copies between CPU and GPU: uploads that do not wait, and reads that wait only once for several tensors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor


def upload(numbers: ArrayLike, device: torch.device) -> Tensor:
    """Return integers as a tensor on the device, without waiting for the copy.

    On CUDA the copy is made from pinned memory, which PyTorch's allocator keeps until the copy is done.

    Args:
        numbers: An array, or a nested list.
        device: Where the tensor goes.
    """
    host = torch.from_numpy(np.asarray(numbers))  # five times as fast as torch.as_tensor for a list
    if device.type == "cpu":
        return host
    if device.type == "cuda":
        host = host.pin_memory()
    return host.to(device, non_blocking=True)


def read(*parts: Tensor) -> list[np.ndarray]:
    """Copy several vectors from one device to the CPU in a single transfer, and wait for it.

    Args:
        parts: Vectors, which may have different lengths. If their types differ, all are returned as float64. Tokens and
            indices stay exact, because they are small.

    Returns:
        One array per vector.
    """
    sizes, together = list(map(len, parts)), parts[0]
    if len(parts) > 1:
        mixed = len({part.dtype for part in parts}) > 1
        together = torch.cat([*map(Tensor.double, parts)] if mixed else parts)
    return [vector.numpy() for vector in together.cpu().split(sizes)]
