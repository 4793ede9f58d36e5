"""Push: bursts in which the hand is driven off in a random direction, whatever the policy wants."""

from __future__ import annotations

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress.base import Array, Spells, Stress, level_of
from kerv_cli.worlds.vectors import unit_vector

SECONDS = 0.1
"""Length of a burst."""
LEVELS = (2.0, 4.0, 8.0, 14.0)
"""Bursts per second that begin while none lasts."""


class Push(Stress):
    """In a burst the position group of the action is replaced by its largest displacement in a random direction;
    rotation and gripper stay the policy's."""

    kind = "push"

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Fixes the episode's random numbers and its rate of bursts."""
        self._group = space.dofs_of("position")
        super().begin(task, seed, space)
        self._random = self.draws.random()
        self._spells = Spells.per_second(level_of(LEVELS, self.level), SECONDS, space.control_hz)
        self._half, self._middle = space.half[self._group], space.middle[self._group]
        self._push = self._middle

    def act(self, action: Array, step: int) -> Array:
        """The action, with its position group replaced while a burst lasts."""
        lasts, begins = self._spells.goes_on(self._random)
        if begins:
            self._push = self._middle + unit_vector(self._random, len(self._half)) * self._half
        if not lasts:
            return action
        executed = action.copy()
        executed[self._group] = self._push
        return executed
