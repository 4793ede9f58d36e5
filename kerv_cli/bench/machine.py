"""Measured rates of the device, bytes read and multiply-adds per second; and the stopwatch of the bench."""

from __future__ import annotations

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
_ROWS, _WIDTH = 256, 4096
REPEATS = 7


@dataclass(frozen=True)
class Machine:
    """bandwidth: bytes per second that one pass over a large buffer reads. flops: per second, of a product of 256 rows
    with a matrix of 4096 × 4096 in the weights' number format. Both are the best of the repeats."""

    bandwidth: float
    flops: float

    def floor(self, read: float, flops: float) -> float:
        """Seconds below which a forward of so many bytes and operations cannot come."""
        return max(read / self.bandwidth, flops / self.flops)


def synchronise(device: torch.device) -> None:
    """Waits for the device's work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def timed(work: Callable[[], object], device: torch.device, repeats: int) -> np.ndarray:
    """(repeats,) seconds of `work`, after two runs that do not count."""
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
    """The device's rates with this process's threads."""
    buffer = torch.ones(_BUFFER, device=device)
    seconds = timed(buffer.sum, device, REPEATS).min()
    del buffer
    x = torch.ones(_ROWS, _WIDTH, dtype=dtype, device=device)
    product = product_with(torch.ones(_WIDTH, _WIDTH, device=device), dtype)
    best = timed(lambda: product(x), device, REPEATS).min()
    return Machine(4.0 * _BUFFER / float(seconds), 2.0 * _ROWS * _WIDTH**2 / float(best))


def product_with(weight: Tensor, dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    """The function rows -> rows times the weight, as a forward on the weight's device multiplies in this format."""
    if weight.device.type == "cpu" and dtype == torch.bfloat16 and multiplies_bfloat16():
        return BlockedLinear(weight)
    if weight.device.type == "cpu" and dtype == torch.float32:
        compiled = Program(lambda rows: F.linear(rows, weight), (1, weight.shape[1]))
        return lambda rows: compiled(rows)[0]
    plain = weight.to(dtype)
    return lambda rows: rows @ plain
