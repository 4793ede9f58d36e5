"""Example: a predictor of your own, which drafts and fills in after a rejection: the mean of the last two actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.registry import PREFILL, NoSettings, add

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context
    from kerv_cli.methods.kerv.prediction import PredictionProposer


class Mean:
    name = "mean"

    def __init__(self, held: np.ndarray) -> None:
        self.held = held

    def predict(self, history: np.ndarray, steps: int) -> np.ndarray | None:
        """history (m, D) in [-1, 1], oldest first -> (steps, D); strict DoFs keep their last value."""
        if not len(history):
            return None
        return np.tile(np.where(self.held, history[-1], history[-2:].mean(0)), (steps, 1))


def build(settings: NoSettings, context: Context) -> Mean:
    return Mean(context.target.actions.is_strict)


def propose(settings: NoSettings, context: Context) -> PredictionProposer:
    from kerv_cli.methods.kerv.prediction import PredictionProposer

    return PredictionProposer(build(settings, context))


add("proposer", "mean", f"{__name__}:propose", when=PREFILL, chains=True, predictor=f"{__name__}:build")
