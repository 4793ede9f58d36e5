"""Levels at which a gate's risk is certified: Learn-then-Test over episodes (docs/methods.md §4.6; Angelopoulos et al.
2021)."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

GRID = 40  # candidate levels: quantiles of the scores


def hoeffding_bentkus(mean: float, alpha: float, n: int) -> float:
    """p-value of the hypothesis that n independent variables in [0, 1] with this mean have an expectation above alpha;
    the smaller of Hoeffding's and Bentkus' tails (Bates et al. 2021, §3.1)."""
    from scipy.stats import binom  # 60 MB, which most commands do not need

    if n == 0 or mean >= alpha:
        return 1.0
    entropy = (1 - mean) * math.log((1 - mean) / (1 - alpha)) + (mean * math.log(mean / alpha) if mean > 0 else 0.0)
    bentkus = math.e * float(binom.cdf(math.ceil(n * mean), n, alpha))
    return min(1.0, math.exp(-n * entropy), bentkus)


def betting(values: np.ndarray, alpha: float) -> float:
    """p-value of the same hypothesis from the values (n,) themselves: 1 ÷ the wealth of a mixture of bets against it
    (Waudby-Smith and Ramdas 2024). Sharper than `hoeffding_bentkus` where they vary little."""
    bets = np.linspace(0.1, 0.95, 10)[:, None] / (1 - alpha)
    wealth = np.exp(np.log1p(bets * (alpha - values[None])).sum(1)).mean()
    return float(min(1.0, 1 / max(wealth, 1e-300)))


@dataclass(frozen=True)
class Certified:
    """Result for one gate. level: least score that skips, inf where nothing could be certified. share: of the decodes
    that it skips. risk: mean loss of those. p: of the level's test, or of the safest level's where that failed.
    episodes: tested on."""

    level: float
    share: float
    risk: float
    p: float
    episodes: int


def episode_means(skipped: np.ndarray, losses: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """Mean loss over the skipped decodes of every episode that has some.

    skipped (n,) bool, losses (n,), episodes (n,) of n decodes. Decodes of an episode depend on each other, episodes do
    not: the episode is the unit of every test.
    """
    _, at = np.unique(episodes[skipped], return_inverse=True)
    means: np.ndarray = np.bincount(at, losses[skipped]) / np.bincount(at)
    return means


def p_value(means: np.ndarray, epsilon: float) -> float:
    """Of the hypothesis that the episodes' expected mean loss is above ε: the smaller of two tests, doubled."""
    tails = hoeffding_bentkus(float(means.mean()), epsilon, len(means)), betting(means, epsilon)
    return min(1.0, 2 * min(tails))


def certify(scores: np.ndarray, losses: np.ndarray, episodes: np.ndarray, epsilon: float, delta: float) -> Certified:
    """The lowest level λ such that, with probability 1 − δ over the episodes, the risk of score ≥ λ is at most ε. The
    risk is an episode's mean loss over its skipped decodes, expected over episodes that skip.

    scores, losses, episodes: (n,) of n decodes, in which every draft was compared with the target. Levels are tested
    from the safest on that skips in enough episodes to be certified at all, each at δ, up to the first that fails
    (fixed-sequence testing); which episodes skip is known without their losses.
    """
    needed, best, p = episodes_needed(epsilon, delta), None, 1.0
    levels = np.unique(np.quantile(scores, np.linspace(0, 1, GRID + 1)[:-1], method="inverted_cdf"))[::-1]
    for level in levels.tolist():
        skipped = scores >= level
        if len(np.unique(episodes[skipped])) < needed:
            continue
        means = episode_means(skipped, losses, episodes)
        p = p_value(means, epsilon)
        if p > delta:
            break
        best = Certified(level, float(skipped.mean()), float(means.mean()), p, len(means))
    return best or Certified(math.inf, 0.0, math.nan, p, len(np.unique(episodes)))


@functools.cache
def episodes_needed(epsilon: float, delta: float) -> int:
    """Fewest episodes that certify anything, none of them with a loss."""
    n = 1
    while p_value(np.zeros(n), epsilon) > delta:
        n += 1
    return n
