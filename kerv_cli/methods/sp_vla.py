"""SP-VLA (docs/methods.md §6.1): a regression predicts the chunk if the hand is fast; else the target decodes it."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number
from kerv_cli.base.registry import SkipPart
from kerv_cli.engine.decisions import SkipDecision
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk, Situation
    from kerv_cli.methods.context import Context
    from kerv_cli.methods.kerv.prediction import Ridge


@dataclass
class SpeedSkipSettings:
    """SP-VLA: while the hand is fast, execute a chunk that a ridge regression predicts from the last actions."""

    kind: str = "speed"
    v_min: float = number(0.3, 0, 1000)  # lowest hand speed at which the regression is used, metres per second
    v_max: float = number(1000.0, 0, 1000)  # highest hand speed at which the regression is used
    buffer: int = number(6, 2, 10)  # number of last actions that the regression reads (paper: n)
    share: float = number(0.5, 0, 1)  # the target must have decoded more than this share of them (paper: τ)
    penalty: float = number(1e-4, 0, 1e6)  # ridge penalty λ

    def check_together(self, prefix: str) -> None:
        """Refuse a `v_min` above `v_max`.

        Raises:
            UsageError: `v_min` is above `v_max`.
        """
        if self.v_min > self.v_max:
            raise UsageError(f"skip.v_min={self.v_min:g} skip.v_max={self.v_max:g}: v_min must not be above v_max")


@SkipPart("speed", SpeedSkipSettings, colour=0x8C6D31)
class SpeedSkip(Skip):
    """SP-VLA: executes a predicted chunk if the hand is fast and the target decoded enough of the last actions.

    Otherwise the target decodes the chunk. The prediction is a ridge regression on the last `buffer` executed actions.

    Attributes:
        decoded: For each of the last `buffer` actions, whether the target decoded it.
        executed: Number of actions executed in this episode.
        by_target: Whether the target decoded the last chunk. If not, the chunk was predicted.
    """

    def __init__(self, settings: SpeedSkipSettings, ridge: Ridge) -> None:
        self.settings, self.ridge = settings, ridge
        self.decoded: deque[bool] = deque(maxlen=settings.buffer)
        self.executed, self.by_target = 0, True

    @classmethod
    def build(cls, settings: SpeedSkipSettings, context: Context) -> SpeedSkip:
        """Build the part that the setting `skip=speed` chooses."""
        from kerv_cli.methods.kerv.prediction import Ridge

        target = context.target
        return cls(settings, Ridge(target.actions.is_strict, settings.penalty, settings.buffer, target.chunk))

    def begin(self, task: str, seed: int) -> None:
        """Begin an episode: forget the last actions."""
        self.decoded.clear()
        self.executed, self.by_target = 0, True

    def take(self, chunk: Chunk) -> SkipDecision:
        """Return the predicted chunk if the hand is fast and the target decoded enough actions, else no chunk."""
        executed = len(chunk.situation.path) - 1
        self.decoded.extend([self.by_target] * (executed - self.executed))
        self.executed = executed
        predicted = self.ridge.predict(chunk.situation.history.values(), chunk.steps)
        self.by_target = predicted is None or not self._is_intuitive(chunk.situation, chunk.space.control_hz)
        if predicted is None or self.by_target:
            return SkipDecision()
        return SkipDecision(chunk.space.bins_of(predicted).flatten().tolist(), self.ridge.name)

    def _is_intuitive(self, situation: Situation, control_hz: float) -> bool:
        """Return whether the hand is fast enough, and the target decoded more than `share` of the last actions."""
        speed = control_hz * math.dist(situation.path[-1], situation.path[-2])
        s = self.settings
        return s.v_min <= speed <= s.v_max and sum(self.decoded) > s.share * s.buffer
