"""Intervals and tests of docs/methods.md §7, on plain arrays."""

from __future__ import annotations

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
    """Episodes by success of the baseline and of the method from the same initial state; expected ones need not be
    whole."""

    both: float
    only_baseline: float
    only_method: float
    neither: float


_Z = NormalDist().inv_cdf(0.975)
NO_ESTIMATE = Estimate(math.nan, math.nan, math.nan)
MOST_PAIRS = 10_000
"""Nobody runs more: what needs more says only that."""


def wilson(successes: float, episodes: float, confidence: float = 0.95) -> Estimate:
    """A success rate with its Wilson score interval (Newcombe, Statistics in Medicine 17, 1998, method 3); NaN without
    episodes. Written out here: scipy.stats alone takes 60 MB."""
    if episodes == 0:
        return NO_ESTIMATE
    rate, z = successes / episodes, NormalDist().inv_cdf(0.5 + confidence / 2)
    middle, scale = 2 * successes + z**2, 2 * (episodes + z**2)
    reach = z * math.sqrt(z**2 + 4 * successes * (1 - rate))
    low = (middle - reach) / scale if successes else 0.0
    high = (middle + reach) / scale if successes < episodes else 1.0
    return Estimate(rate, low, high)


def mean_of(groups: Sequence[Estimate]) -> Estimate:
    """The unweighted mean of independent estimates, e.g. of the groups' success rates.

    A mean of proportions has no Wilson interval of its own; the method of variance estimates recovery (Zou and Donner,
    2008) combines those of the groups, lopsided as they are, and is the interval of the group where there is one.
    """
    if not groups:
        return NO_ESTIMATE
    values, lows, highs = np.array(groups).T
    below, above = (math.sqrt(((bounds - values) ** 2).sum()) / len(groups) for bounds in (lows, highs))
    mean = float(values.mean())
    return Estimate(mean, mean - below, mean + above)


def paired_counts(baseline: np.ndarray, method: np.ndarray) -> PairedCounts:
    """Two bool arrays (pairs,) of successes from the same initial states."""
    a, b = np.asarray(baseline, dtype=bool), np.asarray(method, dtype=bool)
    return PairedCounts(int((a & b).sum()), int((a & ~b).sum()), int((~a & b).sum()), int((~a & ~b).sum()))


def paired_difference(counts: PairedCounts, confidence: float = 0.95) -> Estimate:
    """Success rate of the method minus the baseline's from the same initial states, with its interval.

    Newcombe's hybrid score interval for paired proportions (Statistics in Medicine 17, 1998, method 10): the two Wilson
    intervals, combined with the pairs' correlation. NaN without pairs.
    """
    pairs = sum(counts)
    if not pairs:
        return NO_ESTIMATE
    both, only_baseline, only_method, neither = counts
    first, second = both + only_method, both + only_baseline  # successes of the method, of the baseline
    rates = first / pairs, second / pairs
    bounds = wilson(first, pairs, confidence), wilson(second, pairs, confidence)
    product = first * (pairs - first) * second * (pairs - second)
    surplus = float(both * neither - only_method * only_baseline)
    if surplus > 0:
        surplus = max(surplus - pairs / 2, 0.0)
    phi = surplus / math.sqrt(product) if product else 0.0

    def reach(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a**2 - 2 * phi * a * b + b**2))

    difference = rates[0] - rates[1]
    low = difference - reach(rates[0] - bounds[0].low, bounds[1].high - rates[1])
    high = difference + reach(bounds[0].high - rates[0], rates[1] - bounds[1].low)
    return Estimate(difference, low, high)


def _spread(effects: np.ndarray, strata: Sequence[str], clusters: Sequence[str]) -> float:
    """Half the width of the 95 % interval of a sum of effects (n,) that is 0 at the estimate.

    The clusters of a stratum are independent and what is in one is not: the sum's variance is that of the clusters'
    sums, stratum by stratum, with Student's t at as many degrees of freedom as clusters less strata. Strata of one
    cluster have no variance of their own and count as the clusters of one stratum (Cochran, Sampling Techniques,
    section 5A.12), which adds how much the strata differ. NaN for a single cluster.
    """
    from scipy.special import stdtrit

    at, of = _numbers_of(strata), _numbers_of([f"{a}|{b}" for a, b in zip(strata, clusters, strict=True)])
    sums, stratum = np.bincount(of, effects), np.zeros(int(of.max()) + 1, int)
    stratum[of] = at
    stratum = np.where(np.bincount(stratum)[stratum] == 1, -1, stratum)
    variance, freedom = 0.0, 0
    for number in np.unique(stratum):
        parts = sums[stratum == number]
        # the only stratum of one cluster has nothing to be compared with: the whole sum counts
        variance += len(parts) * float(parts.var(ddof=1)) if len(parts) > 1 else float(parts[0]) ** 2
        freedom += len(parts) - 1
    return float(stdtrit(freedom, 0.975)) * math.sqrt(variance) if freedom else math.nan


def ratio(
    numerators: np.ndarray,
    denominators: np.ndarray,
    strata: Sequence[str] | None = None,
    clusters: Sequence[str] | None = None,
) -> Estimate:
    """Sum over sum of two arrays (episodes,), with the 95 % interval of a ratio estimator: clusters are independent,
    what happens within one is not. An episode with a denominator of 0 says nothing and does not count. NaN bounds for
    one that counts.

    Args:
        strata: (episodes,) task of each; without, all are of one.
        clusters: (episodes,) seed of each, so that repeats count together; without, every episode is one.
    """
    a, b = np.asarray(numerators, dtype=np.float64), np.asarray(denominators, dtype=np.float64)
    counts = b > 0
    tasks = np.zeros(a.size, int) if strata is None else np.asarray(strata)
    seeds = np.arange(a.size) if clusters is None else np.asarray(clusters)
    a, b = a[counts], b[counts]
    value = float(a.sum() / b.sum())
    reach = _spread((a - value * b) / b.sum(), tasks[counts].tolist(), seeds[counts].tolist())
    return Estimate(value, value - reach, value + reach)


def pairs_to_settle(counts: PairedCounts, margin: float) -> float:
    """About how many pairs would show non-inferiority at `margin`, if the four outcomes' rates stayed as they are: the
    least that bring the lower bound of `paired_difference` above -margin. Infinite where the difference itself lies
    there or below; NaN without pairs."""
    pairs = sum(counts)
    if not pairs:
        return math.nan
    if (counts.only_method - counts.only_baseline) / pairs <= -margin:
        return math.inf

    def shows(number: float) -> bool:
        more = PairedCounts(*(count * number / pairs for count in counts))
        return paired_difference(more).low > -margin

    low, high = 0.0, 1.0
    while not shows(high):
        low, high = high, 2 * high
    while high - low > max(0.5, high / 1000):
        middle = (low + high) / 2
        low, high = (low, middle) if shows(middle) else (middle, high)
    return math.ceil(high)


def mcnemar(counts: PairedCounts) -> float:
    """Exact two-sided p of McNemar's test, that discordant pairs favour either side equally; 1 without such pairs."""
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
    """Ratio of mean times, baseline over method, with the 95 % interval of its logarithm.

    Blocks are the clusters of a task, because the episodes of a block share the machine's state. Where every task has
    one block, the tasks are the clusters, and the interval contains how much they differ; where there is one block in
    all, its pairs are, and the interval says nothing of another state of the machine.

    Args:
        baseline: (pairs,) time of the baseline's episodes, any unit.
        method: (pairs,) the method's, same initial states, same unit.
        strata: (pairs,) task of each pair.
        groups: (pairs,) difficulty group of each pair: the means are then unweighted means over the groups' means.
        blocks: (pairs,) block of each pair; without, every pair is a block.

    Returns:
        NaN without pairs; NaN bounds for a single one.
    """
    a, b = np.asarray(baseline, dtype=np.float64), np.asarray(method, dtype=np.float64)
    if a.size == 0:
        return NO_ESTIMATE
    weights = _weights(a.size, groups)
    mean_a, mean_b = float(weights @ a), float(weights @ b)
    pairs = [str(number) for number in range(a.size)]
    clusters = pairs if blocks is None or len(set(zip(strata, blocks, strict=True))) == 1 else blocks
    reach = math.exp(_spread(weights * (a / mean_a - b / mean_b), strata, clusters))
    return Estimate(mean_a / mean_b, mean_a / mean_b / reach, mean_a / mean_b * reach)


def _numbers_of(names: Sequence[str]) -> np.ndarray:
    """(n,) numbers 0, 1, … of the distinct names."""
    numbers: np.ndarray = np.unique(np.asarray(names, dtype=object).astype(str), return_inverse=True)[1]
    return numbers


def _weights(pairs: int, groups: Sequence[str] | None) -> np.ndarray:
    """Weight of every pair in the mean, summing to 1: uniform, or uniform over groups."""
    if groups is None:
        return np.full(pairs, 1.0 / pairs)
    _, members, sizes = np.unique(np.asarray(groups, dtype=object).astype(str), return_inverse=True, return_counts=True)
    return 1.0 / (sizes[members] * len(sizes))
