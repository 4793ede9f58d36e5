"""What a served policy refuses to act on: states unlike its demonstrations', and numbers that are not finite."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import KervError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.protocol import Target

REFUSE, HOLD = "refuse", "hold"
"""Answers to a state out of range: an error, or the last action once more."""
LEAST_WIDTH = 1.0
"""Width of the range of a number that hardly moved in the demonstrations, in its own unit."""


class StateRange:
    """The range of the states on which a policy may act.

    Args:
        low: (p,) lowest numbers of the demonstrations.
        high: (p,) highest numbers.
        names: Names of the first numbers.
        margin: How many widths of the range are added on each side.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, names: tuple[str, ...], margin: float) -> None:
        added = margin * np.where(high - low < LEAST_WIDTH / 100, LEAST_WIDTH, high - low)
        self.low, self.high, self.names = low - added, high + added, names

    def outside(self, observation: Observation) -> str:
        """Say which number is out of range; empty if none is."""
        numbers = observation.state[: len(self.low)]
        beyond = np.flatnonzero((numbers < self.low) | (numbers > self.high))
        if not len(beyond):
            return ""
        first = int(beyond[0])
        name = self.names[first] if first < len(self.names) else f"number {first}"
        return (
            f"the state is out of range: {name} is {numbers[first]:.4g}, the policy was trained on "
            f"{self.low[first]:.4g} to {self.high[first]:.4g}, margin included"
        )


class Finite:
    """A target that notes whether its prompts and logits are finite."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._fine: list[Tensor] = []  # read once per decode, so that no forward waits for the device

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)

    def encode(self, observation: Observation) -> Tensor:
        """Return the target's prompt."""
        return self._noted(self._target.encode(observation))

    def head(self, hidden: Tensor) -> Tensor:
        """Return the target's logits."""
        return self._noted(self._target.head(hidden))

    def _noted(self, numbers: Tensor) -> Tensor:
        self._fine.append(torch.isfinite(numbers).all())
        return numbers

    def check(self) -> None:
        """Raise KervError if the decode computed numbers that are not finite."""
        fine, self._fine = self._fine, []
        if fine and not bool(torch.stack(fine).all()):
            raise KervError("the policy computed numbers that are not finite: no action is sent")
