"""The alarm of a risk-controlled skip: evidence from audits that the risk has left ε, and the evidence at which it is
raised (docs/methods.md §4.6, ours)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

BETS = np.linspace(0.1, 0.9, 9)  # shares of the wealth that can be lost on one loss
DRAWS = 20  # of the audits, per recorded episode


class Evidence:
    """Evidence about the mean of losses in [0, 1], from those added so far: two e-processes, each a mixture of bets
    (Waudby-Smith and Ramdas 2024). Where every loss, given those before it, is expected at most (at least) ε, `above`
    (`below`) reaches 1/δ with probability δ at most, whenever one looks. Losses of episodes that differ in risk are not
    such: `alarm_level` counts instead.

    shape: of what is added, for several sequences at once.
    """

    def __init__(self, epsilon: float, shape: tuple[int, ...] = ()) -> None:
        self.epsilon, self.shape = epsilon, shape
        self.reset()

    def reset(self) -> None:
        """No loss was added."""
        self._above = np.ones((*self.shape, len(BETS)))
        self._below = np.ones((*self.shape, len(BETS)))

    def add(self, loss: float, where: np.ndarray | bool = True) -> None:
        """One more loss, in those of the sequences."""
        excess = loss - self.epsilon
        self._above[where] *= 1 + BETS / self.epsilon * excess
        self._below[where] *= 1 - BETS / (1 - self.epsilon) * excess

    @property
    def above(self) -> np.ndarray:
        """e-value of "the risk has left ε", per sequence."""
        value: np.ndarray = self._above.mean(axis=-1)
        return value

    @property
    def below(self) -> np.ndarray:
        """e-value of "the risk is within ε", per sequence."""
        value: np.ndarray = self._below.mean(axis=-1)
        return value


class Audit:
    """Collects the losses of decodes that the gate would have skipped but that were verified. Raises an alarm when the
    evidence that the risk is above ε passes `level`, and ends it when the evidence since then that it is not passes
    1/δ."""

    def __init__(self, epsilon: float, delta: float, level: float | None = None) -> None:
        self.evidence, self.end = Evidence(epsilon), 1 / delta
        self.level = self.end if level is None else level
        self.alarm = False

    def reset(self) -> None:
        """A new episode begins: nothing is carried over, so that episodes do not depend on their order."""
        self.evidence.reset()
        self.alarm = False

    def add(self, loss: float) -> None:
        """The loss of one audited decode."""
        self.evidence.add(loss)
        if self.evidence.below > self.end if self.alarm else self.evidence.above > self.level:
            self.alarm = not self.alarm
            self.evidence.reset()


class Audits(Protocol):
    """What determines which trusted drafts are verified all the same; settings of `skip=risk`."""

    epsilon: float
    delta: float
    audit: float
    opening: int
    doubt: float


def largest_evidence(
    trusted: np.ndarray, losses: np.ndarray, settings: Audits, random: np.random.Generator
) -> np.ndarray:
    """(DRAWS,) the largest `above` of one recorded episode without an alarm, for that many draws of its audits.

    trusted (n,) bool, losses (n,) of its decodes in their order.
    """
    evidence, largest, suspicious = Evidence(settings.epsilon, (DRAWS,)), np.ones(DRAWS), np.zeros(DRAWS, bool)
    for index, (trust, loss) in enumerate(zip(trusted.tolist(), losses.tolist(), strict=True)):
        verified = suspicious | (random.random(DRAWS) < settings.audit) | (not trust or index < settings.opening)
        if trust:
            evidence.add(loss, verified)
            largest = np.maximum(largest, evidence.above)
        suspicious = verified & (loss >= settings.doubt)
    return largest


def alarm_level(episodes: Sequence[tuple[np.ndarray, np.ndarray]], settings: Audits) -> float:
    """The evidence that at most the share δ of these episodes ever passes, and of episodes like them.

    episodes: (trusted, losses) of each, as in `largest_evidence`. The quantile is that of one episode more (split
    conformal prediction); the largest of all where they are too few.
    """
    random, count = np.random.default_rng(0), len(episodes)
    largest = np.concatenate([largest_evidence(trusted, losses, settings, random) for trusted, losses in episodes])
    return float(np.quantile(largest, min(1.0, (1 - settings.delta) * (1 + 1 / count)), method="higher"))
