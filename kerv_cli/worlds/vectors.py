"""Lengths of vectors with the same last bit on every CPU.

numpy's norms are OpenBLAS's, whose kernels differ in that bit. What a seed draws and what a world does must not.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_SPLIT = 2.0**27 + 1.0  # Dekker's: parts a double into two halves whose products are exact


def length(vector: NDArray[np.float64]) -> float:
    """Length of a vector (n,). Its sum of squares is rounded once per number, as by a fused multiply-add: so do the
    kernels for AVX-512, with which the datasets so far were recorded, at up to 31 numbers."""
    total = 0.0
    for number in vector.tolist():
        shifted = _SPLIT * number
        high = shifted - (shifted - number)
        low = number - high
        total = math.fsum((high * high, 2.0 * high * low, low * low, total))
    return math.sqrt(total)


def unit_vector(random: np.random.Generator, size: int) -> NDArray[np.float64]:
    """(size,) of length 1, in a direction that is uniform over the sphere."""
    drawn = random.normal(size=size)
    return np.asarray(drawn / length(drawn))
