"""The executed actions that a decode may look back on."""

from __future__ import annotations

from collections import deque

import numpy as np

WINDOW = 10  # KERV's action context AC, control steps


class ActionHistory:
    """The last `window` executed actions, normalised and continuous."""

    def __init__(self, dofs: int, window: int = WINDOW) -> None:
        self.dofs = dofs
        self._actions: deque[np.ndarray] = deque(maxlen=window)
        self._stacked = np.zeros((0, dofs))  # these actions as one array, which nobody writes to
        self._stacked.flags.writeable = False

    def append(self, action: np.ndarray) -> None:
        """An action (D,) in [-1, 1] was executed.

        Raises:
            ValueError: another shape, or a number that is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self.dofs,) or not np.isfinite(action).all():
            raise ValueError(f"an executed action must be {self.dofs} finite numbers, not {action}")
        self._actions.append(action)
        self._stacked = np.array(self._actions)
        self._stacked.flags.writeable = False

    def values(self, pending: np.ndarray | None = None) -> np.ndarray:
        """(m, D), oldest first, m ≤ window.

        pending: (k, D) steps of the present chunk that are known but not yet executed. They are appended as if
        executed, so that the next step is one step ahead instead of k + 1.
        """
        if pending is None or not len(pending):
            return self._stacked
        steps = np.concatenate([self._stacked, np.asarray(pending, dtype=np.float64)])
        return steps[-(self._actions.maxlen or 0) :]
