"""SP-VLA's schedule (docs/methods.md §6.1): the hand's speed decides who gives the next chunk."""

from __future__ import annotations

from collections import deque

import numpy as np

from kerv_cli.engine.chunk import Chunk, Situation
from kerv_cli.engine.parts import Skip
from kerv_cli.methods.context import Context
from kerv_cli.methods.kerv.prediction import Predictor
from kerv_cli.methods.sp_vla import SpeedSkipSettings


class Ridge(Predictor):
    """The line through the last `window` actions, by ridge regression on time. Strict DoFs are held.

    Attributes:
        penalty: λ, on both coefficients.
    """

    name = "ridge"
    least = 2

    def __init__(self, held: np.ndarray, penalty: float, window: int, horizon: int) -> None:
        """penalty: λ, on both coefficients."""
        self.penalty = penalty
        super().__init__(held, window, window, horizon)

    def weights(self, dof: int, window: int) -> np.ndarray:
        """Return (horizon, window): X' (XᵀX + λI)⁻¹ Xᵀ.

        The rows of X are (t, 1) for t = 0, 1, …; X' has later steps.
        """
        times = np.arange(window + self.horizon)
        rows = np.stack([times, np.ones(len(times))], 1)
        past, ahead = rows[:window], rows[window:]
        fitted: np.ndarray = np.linalg.solve(past.T @ past + self.penalty * np.eye(2), past.T)
        return ahead @ fitted


class SpeedSkip(Skip):
    """Fills a chunk by the regression if the hand is fast and the target decoded enough of the buffered actions.

    Attributes:
        decoded: Whether the target decoded each of the last executed actions.
        executed: Actions of the episode so far.
        by_target: Whether the chunk being executed is the target's.
    """

    def __init__(self, settings: SpeedSkipSettings, ridge: Ridge) -> None:
        self.settings, self.ridge = settings, ridge
        self.decoded: deque[bool] = deque(maxlen=settings.buffer)  # of the last executed actions: by the target?
        self.executed = 0  # actions in the episode
        self.by_target = True  # whether the chunk in hand is the target's

    @classmethod
    def build(cls, settings: SpeedSkipSettings, context: Context) -> SpeedSkip:
        """Build skip=speed."""
        target = context.target
        return cls(settings, Ridge(target.actions.is_strict, settings.penalty, settings.buffer, target.chunk))

    def begin(self, task: str, seed: int) -> None:
        """Begin an episode."""
        self.decoded.clear()
        self.executed, self.by_target = 0, True

    def take(self, chunk: Chunk) -> bool:
        """Fill the chunk if the motion is intuitive -> whether it did."""
        executed = len(chunk.situation.path) - 1
        self.decoded.extend([self.by_target] * (executed - self.executed))
        self.executed = executed
        predicted = self.ridge.predict(chunk.situation.history.values(), chunk.steps)
        self.by_target = predicted is None or not self._is_intuitive(chunk.situation, chunk.space.control_hz)
        if predicted is None or self.by_target:
            return False
        chunk.skip(chunk.space.bins_of(predicted).flatten().tolist(), self.ridge.name)
        return True

    def _is_intuitive(self, situation: Situation, control_hz: float) -> bool:
        """Return whether the hand's speed is in range and the target decoded more than `share` of the buffer."""
        speed = control_hz * float(np.linalg.norm(situation.path[-1] - situation.path[-2]))
        s = self.settings
        return s.v_min <= speed <= s.v_max and sum(self.decoded) > s.share * s.buffer
