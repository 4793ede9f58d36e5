"""What a served policy refuses to act on: states far from those that it was trained on, and numbers that are not
finite."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import KervError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.protocol import Target

REFUSE, HOLD = "refuse", "hold"
"""Of `outside`: answer with an error; execute the last action once more."""
LEAST_WIDTH = 1.0
"""Of a number that hardly moved in the demonstrations, in its own unit."""


class StateRange:
    """The range of the numbers that a policy may act on. low, high: the least and the largest of its demonstrations
    (p,). margin: widths of that range which are added on either side."""

    def __init__(self, low: np.ndarray, high: np.ndarray, names: tuple[str, ...], margin: float) -> None:
        more = margin * np.where(high - low < LEAST_WIDTH / 100, LEAST_WIDTH, high - low)
        self.low, self.high, self.names = low - more, high + more, names

    def outside(self, observation: Observation) -> str:
        """Which number of an observation is out of range, in words; empty where none is."""
        numbers = observation.state[: len(self.low)]
        beyond = np.flatnonzero((numbers < self.low) | (numbers > self.high))
        if not len(beyond):
            return ""
        at = int(beyond[0])
        name = self.names[at] if at < len(self.names) else f"number {at}"
        return (
            f"the state is out of range: {name} is {numbers[at]:.4g}, the policy was trained on "
            f"{self.low[at]:.4g} to {self.high[at]:.4g}, margin included"
        )


class Finite:
    """A target, and a check that its prompts and logits are finite."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._fine: list[Tensor] = []  # read once per decode, so that no forward waits for the device

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)

    def encode(self, observation: Observation) -> Tensor:
        """The target's prompt."""
        return self._noted(self._target.encode(observation))

    def head(self, hidden: Tensor) -> Tensor:
        """The target's logits."""
        return self._noted(self._target.head(hidden))

    def _noted(self, numbers: Tensor) -> Tensor:
        self._fine.append(torch.isfinite(numbers).all())
        return numbers

    def check(self) -> None:
        """Raises KervError: the decode computed numbers that are not finite."""
        fine, self._fine = self._fine, []
        if fine and not bool(torch.stack(fine).all()):
            raise KervError("the policy computed numbers that are not finite: no action is sent")
