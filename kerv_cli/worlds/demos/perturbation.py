"""Noise on the actions that an expert executes, so that demonstrations visit states off its path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.vectors import unit_vector

_BURST_STEPS = (3, 8)


def is_perturbed(seed: int, fraction: float) -> bool:
    """Whether the episode of this seed is executed with noise; the `fraction` of such seeds is spread evenly."""
    return int((seed + 1) * fraction) > int(seed * fraction)


class Perturbation:
    """One episode's noise: Gaussian, sometimes a burst in one random direction. Strict DoFs, e.g. a gripper, stay
    clean.

    Attributes:
        sigma: standard deviation of the Gaussian, drawn once; half of a DoF's range is 1.
    """

    def __init__(
        self, task: str, seed: int, space: ActionSpace, noise: tuple[float, float], burst_probability: float
    ) -> None:
        """The noise is a function of task and seed.

        Args:
            task, seed: of the episode.
            space: of the actions that are perturbed.
            noise: (low, high) range of sigma.
            burst_probability: chance per step that a burst of 3 to 8 steps starts.
        """
        self._random = np.random.default_rng([seed, *task.encode()])
        self.sigma = float(self._random.uniform(*noise))
        self._burst_probability = burst_probability
        self._burst_left = 0
        self._noisy = ~space.is_strict
        self._low, self._high = np.array(space.low)[self._noisy], np.array(space.high)[self._noisy]
        self._half, self._middle = space.half[self._noisy], space.middle[self._noisy]
        self._direction = np.zeros(len(self._half))  # normalised

    def __call__(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """The action to execute, (D,) in environment units and within the limits, for the clean `action`."""
        dofs = len(self._half)
        noise = self._random.normal(0.0, self.sigma, size=dofs)
        if self._burst_left == 0 and self._random.random() < self._burst_probability:
            self._burst_left = int(self._random.integers(_BURST_STEPS[0], _BURST_STEPS[1] + 1))
            self._direction = unit_vector(self._random, dofs)
        moved = action[self._noisy] + noise * self._half
        if self._burst_left > 0:
            self._burst_left -= 1
            moved = self._direction * self._half + self._middle
        executed = action.copy()
        executed[self._noisy] = np.clip(moved, self._low, self._high)
        return executed
