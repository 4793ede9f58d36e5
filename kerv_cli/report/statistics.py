"""Intervals and tests of docs/methods.md §7, on plain arrays."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np


class Estimate(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float


class PairedCounts(NamedTuple):
    """Number of pairs by who succeeded from the same initial state. Expected counts may be fractions."""

    both: float
    only_baseline: float
    only_method: float
    neither: float


NO_ESTIMATE = Estimate(math.nan, math.nan, math.nan)
MOST_PAIRS = 10_000
"""Nobody runs more pairs than this, so messages say only "more than 10,000"."""


def wilson(successes: float, episodes: float, confidence: float = 0.95) -> Estimate:
    """Return a success rate with its Wilson score interval; NaN without episodes.

    Newcombe, Statistics in Medicine 17 (1998), method 3. It is written out because `scipy.stats` takes 60 MB of memory.
    """
    if episodes == 0:
        return NO_ESTIMATE
    rate, z = successes / episodes, NormalDist().inv_cdf(0.5 + confidence / 2)
    middle, scale = 2 * successes + z**2, 2 * (episodes + z**2)
    reach = z * math.sqrt(z**2 + 4 * successes * (1 - rate))
    low = (middle - reach) / scale if successes else 0.0
    high = (middle + reach) / scale if successes < episodes else 1.0
    return Estimate(rate, low, high)


def mean_of(groups: Sequence[Estimate]) -> Estimate:
    """Return the unweighted mean of independent estimates, such as the success rates of groups of tasks.

    The interval combines the intervals of the groups by the method of variance estimates recovery (Zou and Donner,
    Statistics in Medicine 27, 2008). With one group it is the interval of that group.
    """
    if not groups:
        return NO_ESTIMATE
    values, lows, highs = np.array(groups).T
    below, above = (math.sqrt(((bounds - values) ** 2).sum()) / len(groups) for bounds in (lows, highs))
    mean = float(values.mean())
    return Estimate(mean, mean - below, mean + above)


def paired_counts(baseline: np.ndarray, method: np.ndarray) -> PairedCounts:
    """Count the pairs of two bool arrays (pairs,) of successes from the same initial states."""
    a, b = np.asarray(baseline, dtype=bool), np.asarray(method, dtype=bool)
    return PairedCounts(int((a & b).sum()), int((a & ~b).sum()), int((~a & b).sum()), int((~a & ~b).sum()))


def paired_difference(counts: PairedCounts, confidence: float = 0.95) -> Estimate:
    """Return the method's success rate minus the baseline's with its interval; NaN without pairs.

    Newcombe's hybrid score interval for paired proportions (Statistics in Medicine 17, 1998, method 10). It combines
    the two Wilson intervals with the correlation of the pairs.
    """
    pairs = sum(counts)
    if not pairs:
        return NO_ESTIMATE
    both, only_baseline, only_method, neither = counts
    method, baseline = (wilson(both + won, pairs, confidence) for won in (only_method, only_baseline))
    surplus = float(both * neither - only_method * only_baseline)
    if surplus > 0:
        surplus = max(surplus - pairs / 2, 0.0)  # correction for continuity
    product = math.prod(pairs**2 * rate * (1 - rate) for rate in (method.value, baseline.value))
    phi = surplus / math.sqrt(product) if product else 0.0

    def reach(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a**2 - 2 * phi * a * b + b**2))

    difference = method.value - baseline.value
    low = difference - reach(method.value - method.low, baseline.high - baseline.value)
    high = difference + reach(method.high - method.value, baseline.value - baseline.low)
    return Estimate(difference, low, high)


def pairs_to_settle(counts: PairedCounts, margin: float) -> float:
    """Return about how many pairs would show non-inferiority if the rates of the four outcomes stayed as they are.

    It is the smallest number that brings the lower bound of `paired_difference` above -margin. It is infinite if ten
    million do not, and NaN without pairs.
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
    """Return the exact two-sided p of McNemar's test; 1 if no pair is discordant.

    McNemar, Psychometrika 12 (1947). The hypothesis is that discordant pairs favour either side equally.
    """
    from scipy.special import bdtr

    lost, won = int(counts.only_baseline), int(counts.only_method)
    return min(1.0, 2 * float(bdtr(min(lost, won), lost + won, 0.5)))


def speedup(
    baseline: np.ndarray,
    method: np.ndarray,
    strata: Sequence[str],
    groups: Sequence[str] | None = None,
    blocks: Sequence[str] | None = None,
) -> Estimate:
    """Return the ratio of mean times, baseline over method, with the 95 % interval of its logarithm.

    The interval is that of a linearised ratio in a stratified cluster sample (Cochran, Sampling Techniques, 1977).
    Blocks are the clusters of a task, because the episodes of a block share the machine's state. If every task has one
    block, the tasks are the clusters. If there is one block in all, its pairs are the clusters, and the interval says
    nothing about another state of the machine.

    Args:
        baseline: (pairs,) time of the baseline's episodes, any unit.
        method: (pairs,) time of the method's episodes from the same initial states.
        strata: (pairs,) task of each pair.
        groups: (pairs,) difficulty group of each pair. With it, each mean is the unweighted mean of the groups' means.
        blocks: (pairs,) block of each pair. Without it, every pair is a block.

    Returns:
        NaN without pairs; NaN bounds for a single pair.
    """
    a, b = np.asarray(baseline, dtype=np.float64), np.asarray(method, dtype=np.float64)
    if a.size == 0:
        return NO_ESTIMATE
    weights = np.full(a.size, 1.0 / a.size)
    if groups is not None:
        _, members, sizes = np.unique(np.asarray(groups, dtype=str), return_inverse=True, return_counts=True)
        weights = 1.0 / (sizes[members] * len(sizes))
    mean_a, mean_b = float(weights @ a), float(weights @ b)
    if blocks is None or len(set(zip(strata, blocks, strict=True))) == 1:
        blocks = [str(number) for number in range(a.size)]
    reach = math.exp(_spread(weights * (a / mean_a - b / mean_b), strata, blocks))
    return Estimate(mean_a / mean_b, mean_a / mean_b / reach, mean_a / mean_b * reach)


def _spread(effects: np.ndarray, strata: Sequence[str], clusters: Sequence[str]) -> float:
    """Return half the width of the 95 % interval of a sum of effects (n,) that is 0 at the estimate.

    Clusters are independent. The variance of the sum is the variance of the clusters' sums, stratum by stratum, with
    Student's t; the degrees of freedom are clusters minus strata. Strata of one cluster count together as one stratum
    (Cochran, Sampling Techniques, section 5A.12). NaN for a single cluster.
    """
    from scipy.special import stdtrit

    stratum_of_pair = np.unique(np.asarray(strata, dtype=str), return_inverse=True)[1]
    names = [f"{stratum}|{cluster}" for stratum, cluster in zip(strata, clusters, strict=True)]
    _, first, cluster_of_pair = np.unique(names, return_index=True, return_inverse=True)
    sums, stratum = np.bincount(cluster_of_pair, effects), stratum_of_pair[first]
    stratum = np.where(np.bincount(stratum)[stratum] == 1, -1, stratum)
    variance, freedom = 0.0, 0
    for number in np.unique(stratum):
        parts = sums[stratum == number]
        # a single one-cluster stratum has nothing to be compared with: its whole sum counts
        variance += len(parts) * float(parts.var(ddof=1)) if len(parts) > 1 else float(parts[0]) ** 2
        freedom += len(parts) - 1
    return float(stdtrit(freedom, 0.975)) * math.sqrt(variance) if freedom else math.nan
