"""Example: a kind of stress of your own: actions drift off in one direction per episode."""

from __future__ import annotations

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress import Array, Stress, StressPart


@StressPart("drift", requires=("actions",))
class Drift(Stress):
    kind = "drift"
    levels = (0.05, 0.1, 0.2, 0.4)  # of half a DoF's range

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        self._low, self._high = np.array(space.low), np.array(space.high)
        super().begin(task, seed, space)
        side = self.generator().choice([-1.0, 1.0], space.dofs)
        self._offset = side * self.amount * (self._high - self._low) / 2

    def act(self, action: Array, step: int) -> Array:
        return np.clip(action + self._offset, self._low, self._high)
