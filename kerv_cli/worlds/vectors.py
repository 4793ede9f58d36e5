"""Compute lengths of vectors with equal results on every CPU, to the last bit.

numpy's norms call OpenBLAS, which rounds differently on different CPUs. Random numbers and simulations must not depend
on the CPU.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_SPLIT = 2.0**27 + 1.0  # Dekker's constant: splits a double into two halves whose products are exact


def length(vector: NDArray[np.float64]) -> float:
    """Return the length of a vector (n,). Squaring a number and adding the square to the sum rounds only once.

    OpenBLAS rounded like this on the CPUs that recorded the first datasets (AVX-512, up to 31 numbers). So those
    datasets can be recorded again bit by bit.
    """
    total = 0.0
    for number in vector.tolist():
        shifted = _SPLIT * number
        high = shifted - (shifted - number)
        low = number - high
        total = math.fsum((high * high, 2.0 * high * low, low * low, total))
    return math.sqrt(total)


def unit_vector(random: np.random.Generator, size: int) -> NDArray[np.float64]:
    drawn = random.normal(size=size)
    return np.asarray(drawn / length(drawn))
