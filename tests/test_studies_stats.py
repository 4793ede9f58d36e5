"""Intervals and tests against closed forms, slower references and simulated coverage."""

import math
from pathlib import Path

import numpy as np
import pytest
from loaded import module_of
from scipy.special import stdtrit
from statsmodels.stats.contingency_tables import mcnemar as statsmodels_mcnemar
from statsmodels.stats.proportion import proportion_confint

from kerv_cli.report.statistics import (
    PairedCounts,
    mcnemar,
    paired_difference,
    pairs_to_settle,
    speedup,
    wilson,
)

SCRIPT = Path(__file__).parents[1] / "scripts/coverage.py"


def test_without_data_nothing_is_estimated():
    assert all(math.isnan(number) for number in (*wilson(0, 0), *paired_difference(PairedCounts(0, 0, 0, 0))))
    assert math.isnan(pairs_to_settle(PairedCounts(0, 0, 0, 0), 0.03))
    assert math.isnan(speedup(np.array([]), np.array([]), []).value)
    single = speedup(np.array([2.0]), np.array([1.0]), ["a"])
    assert (single.value, math.isnan(single.low), math.isnan(single.high)) == (2.0, True, True)


def test_the_interval_of_a_speedup_by_hand():
    """Two tasks with blocks of two and three pairs: blocks are the clusters of a task, Student's t with one and two
    degrees of freedom together."""
    rng = np.random.default_rng(8)
    a, b = rng.uniform(2, 3, 12), rng.uniform(1, 2, 12)
    tasks, blocks = list("aaaabbbbbbbb"), list("112233444555")
    effects = (a / a.sum() - b / b.sum()).tolist()
    sums = [[sum(e for e, block in zip(effects, blocks, strict=True) if block == name) for name in names]
            for names in ("12", "345")]  # fmt: skip
    variance = sum(len(part) * np.var(part, ddof=1) for part in sums)
    reach = math.exp(stdtrit(3, 0.975) * math.sqrt(variance))
    value = a.sum() / b.sum()
    assert speedup(a, b, tasks, blocks=blocks) == pytest.approx((value, value / reach, value * reach))


def test_tasks_are_the_clusters_where_each_has_one_block():
    rng = np.random.default_rng(3)
    a, b, tasks = rng.uniform(2, 3, 20), rng.uniform(1, 2, 20), [str(i // 5) for i in range(20)]
    assert speedup(a, b, tasks, blocks=tasks) == speedup(a, b, ["a"] * 20, blocks=tasks)
    mixed = speedup(a, b, tasks, blocks=["x"] * 5 + [str(i) for i in range(15)])
    assert mixed.low < mixed.value < mixed.high


@pytest.mark.parametrize("blocks", [1, 4])
def test_every_interval_of_a_study_of_ten_tasks_covers_the_truth(blocks):
    """At a nominal 95 %: no less, up to the 150 simulated studies' own error; some are wider than necessary."""
    for name, inside in module_of(SCRIPT).coverage(10, blocks, 150).items():
        assert inside >= 0.95 - 2.6 * math.sqrt(0.05 * 0.95 / 150), name


@pytest.mark.parametrize(("successes", "episodes"), [(0, 7), (12, 12), (3, 8), (187, 200)])
def test_wilson_is_statsmodels(successes, episodes):
    expected = proportion_confint(successes, episodes, 0.05, method="wilson")
    assert wilson(successes, episodes)[1:] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("counts", [(10, 0, 0, 3), (10, 5, 2, 3), (150, 13, 4, 33), (0, 9, 1, 0), (10, 0, 1, 10)])
def test_mcnemar_is_statsmodels(counts):
    both, lost, won, neither = counts
    expected = statsmodels_mcnemar([[both, lost], [won, neither]], exact=True).pvalue
    assert mcnemar(PairedCounts(*counts)) == pytest.approx(min(1.0, expected), abs=1e-12)


@pytest.mark.parametrize(("counts", "correction"), [((36, 12, 2, 0), 0), ((20, 2, 4, 14), 20)])
def test_paired_difference_by_hand(counts, correction):
    """Positively correlated pairs are corrected for continuity by half their number."""
    both, lost, won, neither = counts
    pairs, a, b = sum(counts), both + won, both + lost
    method, baseline = wilson(a, pairs), wilson(b, pairs)
    phi = (both * neither - lost * won - correction) / math.sqrt(a * (pairs - a) * b * (pairs - b))
    ends = [(method.low, baseline.high, -1), (method.high, baseline.low, 1)]
    low, high = (
        method.value - baseline.value + sign * math.sqrt(x**2 - 2 * phi * x * y + y**2)
        for m, other, sign in ends
        for x, y in [(abs(method.value - m), abs(baseline.value - other))]
    )
    assert paired_difference(PairedCounts(*counts)) == pytest.approx((a / pairs - b / pairs, low, high), abs=1e-9)


@pytest.mark.parametrize(
    "counts", [(0, 0, 0, 5), (5, 0, 0, 0), (3, 4, 0, 0), (20, 2, 4, 14), (0, 3, 9, 0), (1, 0, 0, 0)]
)
def test_paired_difference_is_symmetric_and_bounded(counts):
    both, lost, won, neither = counts
    value, low, high = paired_difference(PairedCounts(both, lost, won, neither))
    assert -1 <= low <= value <= high <= 1
    assert low < high
    swapped = paired_difference(PairedCounts(both, won, lost, neither))
    assert swapped == pytest.approx((-value, -high, -low), abs=1e-12)
    failures = paired_difference(PairedCounts(neither, won, lost, both))  # counted instead of successes
    assert failures == pytest.approx((-value, -high, -low), abs=1e-12)


@pytest.mark.parametrize("counts", [(80, 5, 5, 10), (80, 6, 4, 10), (80, 0, 0, 20), (188, 2, 2, 8)])
def test_pairs_to_settle_are_just_enough(counts):
    """So many pairs of the same rates show non-inferiority by the interval of the tables, two per cent fewer do not."""
    needed = pairs_to_settle(PairedCounts(*counts), 0.03)
    enough, short = (PairedCounts(*(c * n / sum(counts) for c in counts)) for n in (needed, 0.98 * needed - 1))
    assert paired_difference(enough).low > -0.03 >= paired_difference(short).low


def test_no_number_of_pairs_shows_what_is_not_so():
    assert pairs_to_settle(PairedCounts(80, 10, 5, 5), 0.03) == math.inf
    assert pairs_to_settle(PairedCounts(97, 3, 0, 0), 0.03) == math.inf
