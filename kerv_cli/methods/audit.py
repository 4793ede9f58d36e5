"""Online audit of a gate: has the risk left ε? (docs/methods.md §4.6)"""

from __future__ import annotations

import numpy as np

BETS = np.linspace(0.1, 0.9, 9)  # shares of the wealth that can be lost on one loss


class Evidence:
    """Anytime-valid evidence about the mean of losses in [0, 1], from those seen so far: two e-processes, each a
    mixture of bets (Waudby-Smith and Ramdas 2024). Whoever stops when one reaches 1/δ errs with probability δ at most,
    whenever he looks.

    above: against "the mean is at most ε"; below: against "the mean is at least ε".
    """

    def __init__(self, epsilon: float) -> None:
        self.epsilon = epsilon
        self.reset()

    def reset(self) -> None:
        """Nothing was seen."""
        self._above = np.ones(len(BETS))
        self._below = np.ones(len(BETS))

    def add(self, loss: float) -> None:
        """One more loss."""
        excess = loss - self.epsilon
        self._above *= 1 + BETS / self.epsilon * excess
        self._below *= 1 - BETS / (1 - self.epsilon) * excess

    @property
    def above(self) -> float:
        """e-value of "the risk has left ε"."""
        return float(self._above.mean())

    @property
    def below(self) -> float:
        """e-value of "the risk is within ε"."""
        return float(self._below.mean())


class Audit:
    """Collects the losses of decodes that the gate would have skipped but that were verified. Raises an alarm when the
    evidence that the risk is above ε reaches 1/δ, and ends it when the evidence since then that it is not does.

    """

    def __init__(self, epsilon: float, delta: float) -> None:
        self.evidence, self.level = Evidence(epsilon), 1 / delta
        self.alarm = False

    def reset(self) -> None:
        """A new episode begins: nothing is carried over, so that episodes do not depend on their order."""
        self.evidence.reset()
        self.alarm = False

    def add(self, loss: float) -> None:
        """The loss of one audited decode."""
        self.evidence.add(loss)
        reached = self.evidence.below if self.alarm else self.evidence.above
        if reached >= self.level:
            self.alarm = not self.alarm
            self.evidence.reset()
