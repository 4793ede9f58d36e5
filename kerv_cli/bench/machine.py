"""Measure what a device can do at best: bytes read per second and arithmetic operations per second."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from kerv_cli.targets.compact.program import Program

_BUFFER = 64 * 2**20  # float32 numbers, 256 MiB: larger than the caches of a server, which hold 100 MB and more
_LEVELS = (2**20, 4 * 2**20, 16 * 2**20, 32 * 2**20)  # bytes of the buffers that measure the bandwidth of CPU caches
_ROWS, _WIDTH = 256, 4096  # of the matrix multiplication that measures operations per second
REPEATS = 7


@dataclass(frozen=True)
class Machine:
    """What a device can do at best: bytes and operations per second, each the best of several measurements.

    Attributes:
        bandwidth: Bytes per second when reading a buffer that is larger than all caches.
        flops: Operations per second of a large matrix multiplication in the number format of the weights.
        caches: (bytes, bandwidth) of smaller buffers that fit into caches, the smallest first. Empty on a GPU.
    """

    bandwidth: float
    flops: float
    caches: tuple[tuple[float, float], ...] = ()

    def bandwidth_of(self, read: float) -> float:
        """Return the bytes per second at which the same `read` bytes can be read again and again.

        This is the bandwidth of the smallest measured buffer that holds the bytes. If no buffer is that large, it is
        `bandwidth`.
        """
        return next((rate for size, rate in self.caches if read <= size), self.bandwidth)

    def bounds(self, read: float, flops: float) -> tuple[float, float]:
        """Return the shortest possible seconds for reading `read` bytes, and for `flops` operations."""
        return read / self.bandwidth_of(read), flops / self.flops

    def best_of(self, other: Machine) -> Machine:
        """Return the higher value of two measurements in each field. Other programs can only make a value lower."""
        caches = [(size, max(a, b)) for (size, a), (_, b) in zip(self.caches, other.caches, strict=True)]
        return Machine(max(self.bandwidth, other.bandwidth), max(self.flops, other.flops), tuple(caches))


def synchronise(device: torch.device) -> None:
    """Wait until a GPU has finished its work. Does nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def timed(work: Callable[[], object], device: torch.device, repeats: int) -> np.ndarray:
    """Run a function `repeats` times after two warm-up runs, and return the seconds (repeats,) of each run."""
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
    """Measure a device's bandwidth and operations per second, with as many threads as torch has in this process.

    Args:
        device: The device.
        dtype: Number format of the matrix multiplication.
    """

    def rate(numbers: int) -> float:
        return 4.0 * numbers / float(timed(buffer[:numbers].sum, device, REPEATS).min())

    on_cpu = device.type == "cpu"
    buffer, width = torch.ones(_BUFFER, device=device), _WIDTH // 4 if on_cpu else _WIDTH
    bandwidth, caches = rate(_BUFFER), [(size, rate(size // 4)) for size in _LEVELS if on_cpu]
    x = torch.ones(_ROWS, width, dtype=dtype, device=device)
    weight = torch.ones(width, width, dtype=dtype, device=device)
    multiply: Callable[..., object] = functools.partial(F.linear, weight=weight)
    if on_cpu and dtype == torch.float32:  # as in a target's forward
        multiply = Program(multiply, (1, width))
    best = timed(lambda: multiply(x), device, REPEATS).min()
    return Machine(bandwidth, 2.0 * _ROWS * width**2 / float(best), tuple(caches))
