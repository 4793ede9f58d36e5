"""Example: a predictor of your own, which drafts and fills in after a rejection: the mean of the last two actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.registry import NoSettings
from kerv_cli.methods.kerv import PredictorPart

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context


@PredictorPart("mean")
class Mean:
    name = "mean"

    def __init__(self, held: np.ndarray) -> None:
        self.held = held

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> Mean:
        return cls(context.target.actions.is_strict)

    def predict(self, history: np.ndarray, steps: int) -> np.ndarray | None:
        """history (m, D) in [-1, 1], oldest first -> (steps, D); strict DoFs keep their last value."""
        if not len(history):
            return None
        return np.tile(np.where(self.held, history[-1], history[-2:].mean(0)), (steps, 1))
