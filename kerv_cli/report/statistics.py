"""Intervals and tests of docs/methods.md §7, on plain arrays."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

RESAMPLES = 10_000
BOOTSTRAP_SEED = 20_260_301  # fixed: the same cells give the same table
_AT_ONCE = 500_000  # numbers drawn or multiplied at a time: memory


class Interval(NamedTuple):
    """A 95 % interval."""

    low: float
    high: float


class Estimate(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float


class PairedCounts(NamedTuple):
    """Episodes by success of the baseline and of the method from the same initial state."""

    both: int
    only_baseline: int
    only_method: int
    neither: int


NO_ESTIMATE = Estimate(math.nan, math.nan, math.nan)


def wilson(successes: int, episodes: int, confidence: float = 0.95) -> Interval:
    """Wilson score interval of a success rate (Newcombe, Statistics in Medicine 17, 1998, method 3); NaN without
    episodes. Written out here, as McNemar's test is: scipy.stats alone takes 60 MB."""
    if episodes == 0:
        return Interval(math.nan, math.nan)
    rate, z = successes / episodes, NormalDist().inv_cdf(0.5 + confidence / 2)
    middle, scale = 2 * successes + z**2, 2 * (episodes + z**2)
    reach = z * math.sqrt(z**2 + 4 * successes * (1 - rate))
    low = (middle - reach) / scale if successes else 0.0
    high = (middle + reach) / scale if successes < episodes else 1.0
    return Interval(low, high)


def macro_wilson(groups: Sequence[tuple[int, int]], confidence: float = 0.95) -> Interval:
    """Interval of the unweighted mean of the groups' success rates, from their Wilson intervals.

    A mean of proportions has no Wilson interval of its own; the method of variance estimates recovery (Zou and
    Donner, 2008) combines those of the groups and is the Wilson interval where there is one group.

    Args:
        groups: (successes, episodes) per group, at least one episode each.
    """
    if not groups:
        return Interval(math.nan, math.nan)
    rates = np.array([successes / episodes for successes, episodes in groups])
    bounds = np.array([wilson(successes, episodes, confidence) for successes, episodes in groups])  # (groups, 2)
    spread = np.sqrt(((bounds - rates[:, None]) ** 2).sum(axis=0)) / len(groups)
    mean = float(rates.mean())
    return Interval(mean - float(spread[0]), mean + float(spread[1]))


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


def ratio(numerators: np.ndarray, denominators: np.ndarray) -> Estimate:
    """Sum over sum of two arrays (episodes,), with the 95 % interval of a ratio estimator: episodes are independent,
    what happens within one is not (Cochran, Sampling Techniques, section 2.11; Student's t, as there may be few of
    them). An episode with a denominator of 0 says nothing and does not count. NaN bounds for one that counts."""
    from scipy.special import stdtrit

    a, b = np.asarray(numerators, dtype=np.float64), np.asarray(denominators, dtype=np.float64)
    a, b = a[b > 0], b[b > 0]
    value = float(a.sum() / b.sum())
    if a.size < 2:
        return Estimate(value, math.nan, math.nan)
    spread = float(((a - value * b) ** 2).sum() * a.size / (a.size - 1))
    reach = float(stdtrit(a.size - 1, 0.975)) * math.sqrt(spread) / float(b.sum())
    return Estimate(value, value - reach, value + reach)


def pairs_to_settle(counts: PairedCounts, margin: float, z: float = 1.96) -> float:
    """About how many pairs would show non-inferiority at `margin`, if the four outcomes' rates stayed as they are: the
    lower bound of the normal interval of the difference then lies at -margin. Infinite where the difference itself lies
    there or below; NaN without pairs."""
    pairs = sum(counts)
    if not pairs:
        return math.nan
    difference = (counts.only_method - counts.only_baseline) / pairs
    # one discordant pair at least: none so far does not prove that there are none
    discordant = max(1, counts.only_method + counts.only_baseline) / pairs
    room = margin + difference
    return max(1, math.ceil(z**2 * (discordant - difference**2) / room**2)) if room > 0 else math.inf


def mcnemar(counts: PairedCounts) -> float:
    """Exact two-sided p of McNemar's test, that discordant pairs favour either side equally; 1 without such pairs."""
    discordant = counts.only_baseline + counts.only_method
    if discordant == 0:
        return 1.0
    # whole numbers until the last division: exact
    fewer, ways, tail = min(counts.only_baseline, counts.only_method), 1, 1
    for chosen in range(fewer):
        ways = ways * (discordant - chosen) // (chosen + 1)
        tail += ways
    return min(1.0, 2 * tail / 2**discordant)


def speedup(
    baseline: np.ndarray,
    method: np.ndarray,
    strata: Sequence[str],
    groups: Sequence[str] | None = None,
    blocks: Sequence[str] | None = None,
    *,
    resamples: int = RESAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Estimate:
    """Ratio of mean times, baseline over method, with a paired bootstrap 95 % interval.

    Within every stratum (the task) blocks are drawn with replacement, then pairs within each drawn block, both times of
    a pair together; every draw gives a ratio of means. So the interval takes into account that the episodes of a block
    share the machine's state. Where pairs do not depend on their block, it is wider than necessary, never narrower.

    Args:
        baseline: (pairs,) time of the baseline's episodes, any unit.
        method: (pairs,) the method's, same initial states, same unit.
        strata: (pairs,) task of each pair.
        groups: (pairs,) difficulty group of each pair: the means are then unweighted means over the groups' means.
        blocks: (pairs,) block of each pair; without, every pair is a block.

    Returns:
        NaN without pairs; NaN bounds where a stratum has one pair only, which resampling cannot vary.
    """
    a, b = np.asarray(baseline, dtype=np.float64), np.asarray(method, dtype=np.float64)
    if a.size == 0:
        return NO_ESTIMATE
    times = np.stack([a, b], axis=1)  # (pairs, 2)
    weights = _weights(a.size, groups)
    mean_a, mean_b = weights @ times
    value = float(mean_a / mean_b)
    stratum_numbers = _numbers_of(strata)
    if np.bincount(stratum_numbers).min() < 2:
        return Estimate(value, math.nan, math.nan)
    block_numbers = np.arange(a.size) if blocks is None else _numbers_of(blocks)
    # by stratum, then block; stable, so pairs of a block keep their order
    order = np.lexsort((block_numbers, stratum_numbers))
    sizes = _block_sizes(stratum_numbers[order], block_numbers[order])
    means, first = np.zeros((resamples, 2)), 0
    for counts, drawn in _draws(sizes, resamples, seed):
        rows = order[first : first + counts.shape[1]]
        # a stratum lies within one group, so its pairs have equal weights
        means += _weighted_sums(counts, times[rows]) * (weights[rows].sum() / drawn[:, None])
        first += len(rows)
    low, high = np.quantile(means[:, 0] / means[:, 1], [0.025, 0.975])
    return Estimate(value, float(low), float(high))


def _block_sizes(strata: np.ndarray, blocks: np.ndarray) -> tuple[tuple[int, ...], ...]:
    """Per stratum the numbers of pairs of its blocks, from numbers (pairs,) that are sorted by both."""
    starts = np.flatnonzero(np.diff(strata, prepend=-1))
    parts = np.split(blocks, starts[1:])
    return tuple(tuple(np.unique(part, return_counts=True)[1].tolist()) for part in parts)


@functools.lru_cache(maxsize=2)
def _draws(sizes: tuple[tuple[int, ...], ...], resamples: int, seed: int) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Per stratum how often every resample draws each pair (resamples, pairs), and how many pairs it draws
    (resamples,): by block, then within the block. They depend on the sizes of the blocks alone, so that the settings of
    a study, which share their tasks and seeds, share them."""
    generator = np.random.default_rng(seed)
    return tuple(_stratum_draws(np.array(stratum), resamples, generator) for stratum in sizes)


def _stratum_draws(sizes: np.ndarray, resamples: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """How often every resample draws each pair of one stratum (resamples, pairs), and how many pairs it draws
    (resamples,). sizes (blocks,): the number of pairs in each block."""
    first, pairs = np.cumsum(sizes) - sizes, int(sizes.sum())
    choices = generator.integers(0, sizes.size, size=(resamples, sizes.size))
    counts = np.empty((resamples, pairs), np.uint16)
    rows = max(1, _AT_ONCE // (sizes.size * int(sizes.max())))
    for begin in range(0, resamples, rows):
        blocks = choices[begin : begin + rows]
        within = generator.random((*blocks.shape, int(sizes.max())))
        lengths = sizes[blocks][..., None]
        indices = first[blocks][..., None] + (within * lengths).astype(np.int64)
        indices += pairs * np.arange(len(blocks))[:, None, None]
        used = np.arange(sizes.max()) < lengths  # as many pairs as the block has
        tallies = np.bincount(indices[used], minlength=len(blocks) * pairs)
        counts[begin : begin + rows] = tallies.reshape(-1, pairs)
    return counts, sizes[choices].sum(axis=1)


def _weighted_sums(counts: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Sums (resamples, 2) of the times (pairs, 2), weighted by the counts (resamples, pairs)."""
    rows = max(1, _AT_ONCE // counts.shape[1])
    return np.concatenate([counts[i : i + rows].astype(np.float64) @ times for i in range(0, len(counts), rows)])


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
