"""Noise on the actions that an expert executes, so that demonstrations visit states off its path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.vectors import unit_vector

SIGMA = 0.2, 0.6
"""Lowest and highest standard deviation of the Gaussian, where 1 is half of a DoF's range."""
BURST_PROBABILITY = 0.02
"""Probability per step that a burst begins."""


def is_perturbed(seed: int, fraction: float) -> bool:
    """Return whether the episode of this seed is executed with noise. Such seeds are spread evenly."""
    return int((seed + 1) * fraction) > int(seed * fraction)


class Perturbation:
    """One episode's noise: Gaussian, and bursts of 3 to 8 steps in one random direction. Strict DoFs stay clean.

    Attributes:
        sigma: Standard deviation of the Gaussian, drawn once.
    """

    def __init__(self, task: str, seed: int, space: ActionSpace) -> None:
        """Draw the noise from task and seed, for actions of this space."""
        self._random = np.random.default_rng([seed, *task.encode()])
        self.sigma = float(self._random.uniform(*SIGMA))
        self._burst_left = 0
        self._noisy = ~space.is_strict
        self._low, self._high = np.array(space.low)[self._noisy], np.array(space.high)[self._noisy]
        self._half, self._middle = space.half[self._noisy], space.middle[self._noisy]
        self._direction = np.zeros(len(self._half))  # normalised

    def __call__(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action (D,) to execute instead of the clean one, within the limits."""
        dofs = len(self._half)
        noise = self._random.normal(0.0, self.sigma, size=dofs)
        if self._burst_left == 0 and self._random.random() < BURST_PROBABILITY:
            self._burst_left = int(self._random.integers(3, 9))
            self._direction = unit_vector(self._random, dofs)
        moved = action[self._noisy] + noise * self._half
        if self._burst_left > 0:
            self._burst_left -= 1
            moved = self._direction * self._half + self._middle
        executed = action.copy()
        executed[self._noisy] = np.clip(moved, self._low, self._high)
        return executed
