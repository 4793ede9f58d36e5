"""Tests of a mean by betting: the predictable plug-in of Waudby-Smith and Ramdas (2024).

The hypothesis is that each value in [0, 1] has an expectation of `bound` or more, given those before it. Then bets
against it do not win on average. No bet knows the value that it is laid on. So the wealth reaches 1/δ with probability
δ at most, however often one looks (Ville). Values of different groups, e.g. tasks, must come in random order: sorted
ones refute their order.

For a certificate of success a pair's value is (1 + baseline − method) / 2 ∈ {0, ½, 1} and the bound (1 + m) / 2. The
hypothesis is that a share m or more of the success is lost.
"""

from __future__ import annotations

import math

import numpy as np

MOST = 0.75  # share of the wealth that a bet can lose


def bets(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """Return bets (n,) per unit of bound − value, each from the values before it.

    The number of values has to be settled before the first one is seen.
    """
    count = np.arange(1, len(values) + 1)
    mean = (0.5 + np.cumsum(values)) / (count + 1)
    variance = (0.25 + np.cumsum((values - mean) ** 2)) / (count + 1)
    before = np.concatenate([[0.25], variance])[:-1]
    aim = 2 * math.log(1 / delta) / max(1, len(values))
    return np.minimum(np.sqrt(aim / before), MOST / (1 - bound))


def wealth(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """Return the e-value (n,) of "the mean is below the bound" after each value.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: In (0, 1).
        delta: The level that the bets aim at. The path is valid at every other level too.
    """
    return np.exp(np.cumsum(np.log1p(bets(values, bound, delta) * (bound - values))))


def p_value(values: np.ndarray, bound: float, delta: float) -> float:
    """Return p of the hypothesis that the mean is `bound` or more, however often one looked; 1 without values."""
    return float(1 / max(1.0, wealth(values, bound, delta).max(initial=1.0)))


def more_to_decide(values: np.ndarray, bound: float, delta: float) -> float:
    """Return about how many more values like these would bring the wealth to 1/δ with the best constant bet.

    It is 0 if the wealth is there, infinite if the values do not speak against the hypothesis.
    """
    path = wealth(values, bound, delta)
    if path.max(initial=1.0) >= 1 / delta:
        return 0.0
    shares = np.linspace(0, MOST, 76)[1:, None] / (1 - bound)
    growth = float(np.log1p(shares * (bound - values)).mean(axis=1).max()) if len(values) else 0.0
    missing = math.log(1 / delta) - (math.log(path[-1]) if len(path) else 0.0)
    return math.ceil(missing / growth) if growth > 0 else math.inf
