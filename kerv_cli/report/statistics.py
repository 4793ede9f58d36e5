"""Confidence intervals and tests for success rates and speedups, on plain numpy arrays (docs/methods.md §7)."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Estimate(NamedTuple):
    """An estimated value with the ends of its 95 % confidence interval."""

    value: float
    low: float
    high: float


class PairedCounts(NamedTuple):
    """Counts of the four possible outcomes of a pair. Expected counts may be fractions.

    A pair is one episode of the baseline and one of the method, from the same initial state.
    """

    both: float
    only_baseline: float  # pairs in which only the baseline succeeded
    only_method: float  # pairs in which only the method succeeded
    neither: float


_Z = NormalDist().inv_cdf(0.975)
NO_ESTIMATE = Estimate(math.nan, math.nan, math.nan)
# Messages say "more than 10,000" above this, because nobody runs so many pairs.
MOST_PAIRS = 10_000


def wilson(successes: float, episodes: float) -> Estimate:
    """Estimate a success rate with its Wilson score interval (Newcombe, Statistics in Medicine 17, 1998, method 3).

    The formula is written out here because importing `scipy.stats` takes 60 MB of memory.
    """
    if episodes == 0:
        return NO_ESTIMATE
    rate, z = successes / episodes, _Z
    middle, scale = 2 * successes + z**2, 2 * (episodes + z**2)
    reach = z * math.sqrt(z**2 + 4 * successes * (1 - rate))
    low = (middle - reach) / scale if successes else 0.0
    high = (middle + reach) / scale if successes < episodes else 1.0
    return Estimate(rate, low, high)


def paired_difference(counts: PairedCounts) -> Estimate:
    """Estimate the method's success rate minus the baseline's, from −1 to 1. NaN if there are no pairs.

    The interval is Newcombe's hybrid score interval for paired proportions (Statistics in Medicine 17, 1998, method
    10). It combines the Wilson intervals of the two rates and takes their correlation φ into account.
    """
    pairs = sum(counts)
    if not pairs:
        return NO_ESTIMATE
    both, only_baseline, only_method, neither = counts
    method, baseline = wilson(both + only_method, pairs), wilson(both + only_baseline, pairs)
    surplus = float(both * neither - only_method * only_baseline)
    if surplus > 0:
        surplus = max(surplus - pairs / 2, 0.0)  # correction for continuity
    product = (pairs**2 * method.value * (1 - method.value)) * (pairs**2 * baseline.value * (1 - baseline.value))
    phi = surplus / math.sqrt(product) if product else 0.0

    def reach(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a**2 - 2 * phi * a * b + b**2))

    difference = method.value - baseline.value
    low = difference - reach(method.value - method.low, baseline.high - baseline.value)
    high = difference + reach(method.high - method.value, baseline.value - baseline.low)
    return Estimate(difference, low, high)


def pairs_to_settle(counts: PairedCounts, margin: float) -> float:
    """Estimate how many pairs in all would show that the method loses less than `margin` of success (non-inferiority).

    It is the smallest number for which the lower end of `paired_difference` is above −margin, if the shares of the four
    outcomes stay as observed. Infinite if ten million pairs would not be enough. NaN if there are no pairs.

    Args:
        margin: Share of episodes: 0.03 is three points.
    """
    pairs = sum(counts)
    if not pairs:
        return math.nan

    def shows(number: int) -> bool:
        return paired_difference(PairedCounts(*(count * number / pairs for count in counts))).low > -margin

    numbers = range(1, 10_000_000)
    found = bisect.bisect_left(numbers, True, key=shows)
    return numbers[found] if found < len(numbers) else math.inf


def mcnemar(counts: PairedCounts) -> float:
    """Return the two-sided p-value of McNemar's exact test (McNemar, Psychometrika 12, 1947).

    It is 1 if no pair has exactly one success.
    """
    from scipy.special import bdtr

    lost, won = int(counts.only_baseline), int(counts.only_method)
    return min(1.0, 2 * float(bdtr(min(lost, won), lost + won, 0.5)))


def speedup(baseline: np.ndarray, method: np.ndarray, strata: ArrayLike, blocks: ArrayLike | None = None) -> Estimate:
    """Estimate how many times as fast as the baseline a method is: mean time of the baseline / mean time of the method.

    The 95 % interval is computed for the ratio's logarithm, linearised, in a stratified cluster sample (Cochran,
    Sampling Techniques, 1977). The strata are the tasks. The clusters are blocks: episodes that ran together in one
    process and so share the state of the machine. If every task has only one block, the tasks are the clusters. If
    there is only one block in all, its pairs are the clusters. The interval then holds only for the state that the
    machine was in.

    Args:
        baseline: (pairs,) time of the baseline's episodes, in any unit.
        method: (pairs,) time of the method's episodes from the same initial states, in the same unit.
        strata: (pairs,) task of each pair.
        blocks: (pairs,) block of each pair. If None, every pair counts as a block of its own.
    """
    a, b = np.asarray(baseline, dtype=np.float64), np.asarray(method, dtype=np.float64)
    if a.size == 0:
        return NO_ESTIMATE
    value = float(a.sum() / b.sum())
    strata = np.unique(strata, return_inverse=True)[1]
    clusters = np.unique(range(a.size) if blocks is None else blocks, return_inverse=True)[1]
    clusters = np.unique(strata * a.size + clusters, return_inverse=True)[1]  # blocks are named within their task
    if not clusters.any():
        clusters = np.arange(a.size)
    reach = math.exp(_spread(a / a.sum() - b / b.sum(), strata, clusters))
    return Estimate(value, value / reach, value * reach)


def over_runs(estimates: Sequence[Estimate], same_pairs: bool) -> Estimate:
    """Combine the speedups that several runs measured: their geometric mean.

    The 95 % interval is computed for the logarithm, by Student's t with k − 1 degrees of freedom. If all runs have the
    same pairs, their spread does not show how much the choice of pairs matters. Then the mean of the runs' half widths
    is added to this interval's half width, in quadrature.

    Args:
        same_pairs: Whether all runs measured the same pairs. If not, each run has its own seeds.
    """
    from scipy.special import stdtrit

    values, _, highs = np.array(estimates).T
    logs = np.log(values)
    reach = float(stdtrit(len(logs) - 1, 0.975)) * float(logs.std(ddof=1)) / math.sqrt(len(logs))
    if same_pairs:
        reach = math.hypot(reach, float(np.log(highs / values).mean()))
    value = math.exp(logs.mean())
    return Estimate(value, value / math.exp(reach), value * math.exp(reach))


def _spread(effects: np.ndarray, strata: np.ndarray, clusters: np.ndarray) -> float:
    """Return half the width of the 95 % interval of the logarithm of a speedup. NaN without degrees of freedom.

    Effects are summed within each cluster; the spread of these sums is a stratum's variance. Strata with one cluster
    are merged (Cochran, Sampling Techniques, section 5A.12). The degrees of freedom of Student's t are the number of
    clusters minus the number of strata.

    Args:
        effects: (n,) effect of each pair on the logarithm of the speedup, to first order. They sum to 0.
        strata: (n,) number of each pair's stratum (task), from 0.
        clusters: (n,) number of each pair's cluster (block), from 0. A cluster is in one stratum.
    """
    from scipy.special import stdtrit

    sums, first = np.bincount(clusters, effects), np.unique(clusters, return_index=True)[1]
    stratum = strata[first] + 1
    stratum[np.bincount(stratum)[stratum] == 1] = 0
    sizes = np.bincount(stratum)
    # only one stratum has a single cluster: there is no spread to estimate, so its squared sum counts
    means = np.where(sizes > 1, np.bincount(stratum, sums) / np.maximum(sizes, 1), 0.0)
    squares = np.bincount(stratum, (sums - means[stratum]) ** 2)
    variance = float((squares * sizes / np.maximum(sizes - 1, 1)).sum())
    freedom = len(sums) - np.count_nonzero(sizes)
    return float(stdtrit(freedom, 0.975)) * math.sqrt(variance) if freedom else math.nan
