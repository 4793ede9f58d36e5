"""Kinds of stress that change the executed actions: push and actuation."""

from __future__ import annotations

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress.base import Array, Stress
from kerv_cli.worlds.vectors import unit_vector

PUSH_SECONDS = 0.1
STUCK_SECONDS = 0.25


class Bursts:
    """Bursts of a fixed duration that begin at random, one at a time.

    Args:
        per_second: Mean number of bursts that begin per second while no burst is running.
        seconds: Duration of a burst.
        control_hz: Control steps per second.
    """

    def __init__(self, per_second: float, seconds: float, control_hz: float) -> None:
        self._steps = max(1, round(seconds * control_hz))
        self._chance = min(1.0, per_second / control_hz)
        self._left = 0

    def next_step(self, random: np.random.Generator) -> tuple[bool, bool]:
        """Return whether a burst runs in this control step, and whether it begins in this step."""
        begins = self._left == 0 and bool(random.random() < self._chance)
        if begins:
            self._left = self._steps
        runs = self._left > 0
        self._left -= runs
        return runs, begins


class Push(Stress):
    """Bursts that push the hand in a random direction at full speed. Rotation and gripper are not changed.

    Each level is the mean number of bursts that begin per second while no burst is running.
    """

    kind = "push"
    levels = (2.0, 4.0, 8.0, 14.0)

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Prepare the random numbers of an episode."""
        super().begin(task, seed, space)
        self._random = self.generator()
        self._bursts = Bursts(self.amount, PUSH_SECONDS, space.control_hz)
        self._position = space.dofs_of("position")
        self._half, self._middle = space.half[self._position], space.middle[self._position]
        self._push = self._middle

    def act(self, action: Array, step: int) -> Array:
        """Replace the position part of the action while a burst runs."""
        runs, begins = self._bursts.next_step(self._random)
        if begins:
            self._push = self._middle + unit_vector(self._random, len(self._half)) * self._half
        if not runs:
            return action
        executed = action.copy()
        executed[self._position] = self._push
        return executed


class Actuation(Stress):
    """Noise, wrong gains, and bursts in which one DoF is stuck.

    Strict DoFs (those that must equal the target's token, such as a gripper) are not changed. Each level is (noise,
    gain, stuck):

    - noise: standard deviation of Gaussian noise, where 1 is half of a DoF's range
    - gain: largest relative error of a DoF's gain, drawn once per episode
    - stuck: bursts per second in which one DoF does not move
    """

    kind = "actuation"
    levels = ((0.3, 0.2, 0.5), (0.6, 0.4, 1.0), (0.9, 0.6, 1.5), (1.8, 0.8, 4.0))

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Draw the gains of the DoFs for an episode."""
        super().begin(task, seed, space)
        self._random = self.generator()
        self._noise, gain, stuck = self.amount
        self._loose = ~space.is_strict
        self._low, self._high = np.array(space.low)[self._loose], np.array(space.high)[self._loose]
        self._half, self._middle = space.half[self._loose], space.middle[self._loose]
        self._gain = 1.0 + self._random.uniform(-gain, gain, len(self._half))
        self._bursts = Bursts(stuck, STUCK_SECONDS, space.control_hz)
        self._stuck = 0

    def act(self, action: Array, step: int) -> Array:
        """Apply gains and noise to the action. A stuck DoF does not move."""
        noise = self._random.normal(0.0, self._noise, len(self._half)) * self._half
        runs, begins = self._bursts.next_step(self._random)
        if begins:
            self._stuck = int(self._random.integers(len(self._half)))
        moved = self._middle + (action[self._loose] - self._middle) * self._gain + noise
        if runs:
            moved[self._stuck] = self._middle[self._stuck]
        executed = action.copy()
        executed[self._loose] = np.clip(moved, self._low, self._high)
        return executed
