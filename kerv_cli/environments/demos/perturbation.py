"""Noise on what an expert executes, so that demonstrations visit states beside its path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BURST_STEPS = (3, 8)


def is_perturbed(seed: int, fraction: float) -> bool:
    """Whether the episode of this seed is executed with noise: spreads `fraction` evenly over consecutive seeds."""
    return int((seed + 1) * fraction) > int(seed * fraction)


class Perturbation:
    """One episode's noise: Gaussian on xyz, now and then a burst in one direction. The gripper stays clean.

    Attributes:
        sigma: standard deviation of the Gaussian, drawn once; actions span [-1, 1].
    """

    def __init__(self, task: str, seed: int, noise: tuple[float, float], burst_probability: float) -> None:
        """Fixed by task and seed.

        Args:
            task, seed: the episode.
            noise: (low, high) range of sigma.
            burst_probability: chance per step that a burst of 3 to 8 steps starts.
        """
        self._random = np.random.default_rng([seed, *task.encode()])
        self.sigma = float(self._random.uniform(*noise))
        self._burst_probability = burst_probability
        self._burst_left = 0
        self._direction = np.zeros(3)

    def __call__(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """The action to execute, (4,) in [-1, 1], for the clean `action`."""
        noise = self._random.normal(0.0, self.sigma, size=3)
        if self._burst_left == 0 and self._random.random() < self._burst_probability:
            self._burst_left = int(self._random.integers(_BURST_STEPS[0], _BURST_STEPS[1] + 1))
            direction = self._random.normal(size=3)
            self._direction = direction / np.linalg.norm(direction)
        xyz = action[:3] + noise
        if self._burst_left > 0:
            self._burst_left -= 1
            xyz = self._direction
        return np.append(np.clip(xyz, -1.0, 1.0), action[3])
