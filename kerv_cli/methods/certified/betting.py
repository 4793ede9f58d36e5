"""Tests of the mean of values in [0, 1] by betting: the predictable plug-in of Waudby-Smith and Ramdas (2024).

The hypothesis is that every value's expectation, given those before it, is `bound` or more. Bets against it are then
fair or worse, and none knows the value that it is laid on, so that the wealth ever reaches 1/δ with probability δ at
most, however often one looks (Ville). Values of groups that differ, e.g. tasks, have to come in random order: sorted
ones refute their order.

A certificate of success takes a pair's
v = (1 + baseline − method) / 2 ∈ {0, ½, 1} and (1 + m) / 2: the hypothesis is that m or more of the success is lost.
"""

from __future__ import annotations

import math

import numpy as np

MOST = 0.75  # share of the wealth that a bet can lose


def bets(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """(n,) bets per unit of bound − value, each from the values in front of it and from n, which has to be settled
    before the first value is seen."""
    count = np.arange(1, len(values) + 1)
    mean = (0.5 + np.cumsum(values)) / (count + 1)
    variance = (0.25 + np.cumsum((values - mean) ** 2)) / (count + 1)
    before = np.concatenate([[0.25], variance])[:-1]
    aim = 2 * math.log(1 / delta) / max(1, len(values))
    return np.minimum(np.sqrt(aim / before), MOST / (1 - bound))


def wealth(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """(n,) e-value of "the mean is below the bound" behind every value.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: in (0, 1).
        delta: the level that the bets aim at; the path is valid at every other.
    """
    return np.exp(np.cumsum(np.log1p(bets(values, bound, delta) * (bound - values))))


def p_value(values: np.ndarray, bound: float, delta: float) -> float:
    """Of the hypothesis that the mean is `bound` or more, however often it was looked at; 1 without values."""
    return float(1 / max(1.0, wealth(values, bound, delta).max(initial=1.0)))


def more_to_decide(values: np.ndarray, bound: float, delta: float) -> float:
    """About how many values more would bring the wealth to 1/δ, if they were like these and the best constant bet was
    laid; 0 where it is reached, infinite where these do not speak against the hypothesis."""
    path = wealth(values, bound, delta)
    if path.max(initial=1.0) >= 1 / delta:
        return 0.0
    shares = np.linspace(0, MOST, 76)[1:, None] / (1 - bound)
    growth = float(np.log1p(shares * (bound - values)).mean(axis=1).max()) if len(values) else 0.0
    missing = math.log(1 / delta) - (math.log(path[-1]) if len(path) else 0.0)
    return math.ceil(missing / growth) if growth > 0 else math.inf
