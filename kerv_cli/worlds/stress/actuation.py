"""Actuation: the robot executes an action with white noise, wrong gains and a DoF that sticks for a while."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress.base import Array, Spells, Stress, level_of


@dataclass(frozen=True)
class Level:
    """noise: standard deviation of the white noise, half of a DoF's range is 1. gain: largest relative error of each
    DoF's gain. stuck: spells per second in which one DoF does not move."""

    noise: float
    gain: float
    stuck: float


STUCK_SECONDS = 0.25
"""Length of a spell in which a DoF sticks."""
LEVELS = (Level(0.3, 0.2, 0.5), Level(0.6, 0.4, 1.0), Level(0.9, 0.6, 1.5), Level(1.8, 0.8, 4.0))


class Actuation(Stress):
    """Strict DoFs, such as the gripper's, are executed as they are."""

    kind = "actuation"

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Draws the gains of the DoFs."""
        level = level_of(LEVELS, self.level)
        super().begin(task, seed, space)
        self._random = self.draws.random()
        self._loose = ~space.is_strict
        self._low, self._high = np.array(space.low)[self._loose], np.array(space.high)[self._loose]
        self._half, self._middle = space.half[self._loose], space.middle[self._loose]
        self._noise = level.noise
        self._gain = 1.0 + self._random.uniform(-level.gain, level.gain, len(self._half))
        self._spells = Spells.per_second(level.stuck, STUCK_SECONDS, space.control_hz)
        self._stuck = 0

    def act(self, action: Array, step: int) -> Array:
        """The action with gains and noise; a DoF that sticks stands still."""
        noise = self._random.normal(0.0, self._noise, len(self._half)) * self._half
        lasts, begins = self._spells.goes_on(self._random)
        if begins:
            self._stuck = int(self._random.integers(len(self._half)))
        moved = self._middle + (action[self._loose] - self._middle) * self._gain + noise
        if lasts:
            moved[self._stuck] = self._middle[self._stuck]
        executed = action.copy()
        executed[self._loose] = np.clip(moved, self._low, self._high)
        return executed
