"""What a device can do, measured: bytes read and operations per second."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kerv_cli.targets.compact.bfloat16 import BlockedLinear, multiplies_bfloat16
from kerv_cli.targets.compact.program import Program

_BUFFER = 64 * 2**20  # float32 numbers, 256 MiB: a server's caches hold 100 MB and more
_LEVELS = (2**20, 4 * 2**20, 16 * 2**20, 32 * 2**20)  # bytes of the buffers that show what a CPU's caches can do
_ROWS, _WIDTH = 256, 4096
REPEATS = 7


@dataclass(frozen=True)
class Machine:
    """What a device can do, the best of several repeats.

    Attributes:
        bandwidth: Bytes per second that one pass over a buffer larger than all caches reads.
        flops: Operations per second of a large product in the weights' number format.
        caches: Bytes of a smaller buffer and the bandwidth of repeated passes over it, increasing.
    """

    bandwidth: float
    flops: float
    caches: tuple[tuple[float, float], ...] = ()

    def bandwidth_of(self, read: float) -> float:
        """Return the bandwidth of the smallest level that holds so many bytes."""
        return next((rate for size, rate in self.caches if read <= size), self.bandwidth)

    def bounds(self, read: float, flops: float) -> tuple[float, float]:
        """Return the least seconds for reading so many bytes, and for so many operations."""
        return read / self.bandwidth_of(read), flops / self.flops

    def best_of(self, other: Machine) -> Machine:
        """Return the better rates of two measurements: other programs slow a machine down, none speeds it up."""
        caches = [(size, max(a, b)) for (size, a), (_, b) in zip(self.caches, other.caches, strict=True)]
        return Machine(max(self.bandwidth, other.bandwidth), max(self.flops, other.flops), tuple(caches))


def synchronise(device: torch.device) -> None:
    """Wait for the device's work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def timed(work: Callable[[], object], device: torch.device, repeats: int) -> np.ndarray:
    """Return the seconds (repeats,) of `work`, after two runs that do not count."""
    for _ in range(2):
        work()
    seconds = np.empty(repeats)
    for i in range(repeats):
        synchronise(device)
        begin = time.perf_counter()
        work()
        synchronise(device)
        seconds[i] = time.perf_counter() - begin
    return seconds


@torch.inference_mode()
def measure_machine(device: torch.device, dtype: torch.dtype) -> Machine:
    """Measure the device's rates with this process's threads."""

    def rate(numbers: int) -> float:
        return 4.0 * numbers / float(timed(buffer[:numbers].sum, device, REPEATS).min())

    buffer, width = torch.ones(_BUFFER, device=device), _WIDTH if device.type == "cuda" else _WIDTH // 4
    bandwidth, caches = rate(_BUFFER), [(size, rate(size // 4)) for size in _LEVELS if device.type == "cpu"]
    x, product = torch.ones(_ROWS, width, dtype=dtype, device=device), torch.ones(width, width, device=device)
    best = timed(functools.partial(product_with(product, dtype), x), device, REPEATS).min()
    return Machine(bandwidth, 2.0 * _ROWS * width**2 / float(best), tuple(caches))


def product_with(weight: Tensor, dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    """Return what multiplies rows with a weight as a forward on its device does in this number format."""
    if weight.device.type == "cpu" and dtype == torch.bfloat16 and multiplies_bfloat16():
        return BlockedLinear(weight)
    if weight.device.type == "cpu" and dtype == torch.float32:
        compiled = Program(lambda rows: F.linear(rows, weight), (1, weight.shape[1]))
        return lambda rows: compiled(rows)[0]
    plain = weight.to(dtype)
    return lambda rows: rows @ plain
