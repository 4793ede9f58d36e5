"""Test a mean by betting against it: the predictable plug-in bets of Waudby-Smith and Ramdas (2024).

The hypothesis: each value in [0, 1] has an expectation of at least `bound`, given the values before it. A bettor bets
against the hypothesis. Each bet is made before its value is known. The bettor's wealth starts at 1. If the hypothesis
is true, the bets do not win on average, and the probability that the wealth ever reaches 1/δ is at most δ (Ville's
inequality). So a wealth of 1/δ rejects the hypothesis at level δ, and the wealth may be checked after each value.

Values of different groups, such as tasks, must come in random order. Sorted values would reject the hypothesis only
because of their order.

For a certificate of success, each value comes from two episodes with the same seed, one by autoregressive decoding and
one by the method. Let a be 1 if autoregressive decoding succeeds, else 0. Let b be 1 if the method succeeds, else 0.
The value is (1 + a − b) / 2, so 0, ½ or 1. The bound is (1 + m) / 2, where m is the margin. The hypothesis is that the
method's rate of success is lower by at least m.
"""

from __future__ import annotations

import math

import numpy as np

MOST = 0.75  # largest share of the wealth that a bet may lose


def bets(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """Return the size of the bet on each value. A bet multiplies the wealth by 1 + size · (bound − value).

    Each bet depends only on the values before it and on the number of values n. So n must be chosen before the test.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: The hypothesis is a mean of at least `bound`, in (0, 1).
        delta: Error probability δ for which the bets are optimised.

    Returns:
        (n,) sizes of the bets.
    """
    count = np.arange(1, len(values) + 1)
    mean = (0.5 + np.cumsum(values)) / (count + 1)
    variance = (0.25 + np.cumsum((values - mean) ** 2)) / (count + 1)
    before = np.concatenate([[0.25], variance])[:-1]
    aim = 2 * math.log(1 / delta) / max(1, len(values))
    return np.minimum(np.sqrt(aim / before), MOST / (1 - bound))


def wealth(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """Return the bettor's wealth after each value, (n,). It starts at 1 and grows if the mean is below `bound`.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: The hypothesis is a mean of at least `bound`, in (0, 1).
        delta: Error probability δ for which the bets are optimised. A test at another level δ′ may use the same wealth:
            it rejects if the wealth reaches 1/δ′.
    """
    return np.exp(np.cumsum(np.log1p(bets(values, bound, delta) * (bound - values))))


def p_value(values: np.ndarray, bound: float, delta: float) -> float:
    """Return the p-value of the hypothesis that the mean is at least `bound`; 1 without values.

    A bettor with an initial wealth of 1 bets against the hypothesis. The p-value is 1 divided by the largest wealth so
    far. So it stays valid if it is checked after each value.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: The hypothesis is a mean of at least `bound`, in (0, 1).
        delta: Error probability δ for which the bets are optimised.
    """
    return float(1 / max(1.0, wealth(values, bound, delta).max(initial=1.0)))
