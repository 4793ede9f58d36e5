"""Intervals and tests against closed forms, slower references and simulated coverage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from statsmodels.stats.contingency_tables import mcnemar as statsmodels_mcnemar
from statsmodels.stats.proportion import proportion_confint

from kerv_cli.report.statistics import (
    PairedCounts,
    macro_wilson,
    mcnemar,
    paired_counts,
    paired_difference,
    pairs_to_settle,
    speedup,
    wilson,
)

Z = 1.959963984540054  # 97.5th percentile of the normal distribution


def wilson_formula(successes: int, episodes: int) -> tuple[float, float]:
    p = successes / episodes
    centre = p + Z**2 / (2 * episodes)
    half = Z * math.sqrt(p * (1 - p) / episodes + Z**2 / (4 * episodes**2))
    return (centre - half) / (1 + Z**2 / episodes), (centre + half) / (1 + Z**2 / episodes)


@pytest.mark.parametrize(("successes", "episodes"), [(0, 10), (10, 10), (7, 10), (43, 50), (1, 3)])
def test_wilson_is_the_score_interval(successes: int, episodes: int) -> None:
    assert wilson(successes, episodes) == pytest.approx(wilson_formula(successes, episodes), abs=1e-12)


def test_wilson_without_episodes_is_unknown() -> None:
    assert all(math.isnan(bound) for bound in wilson(0, 0))


def test_macro_interval_of_one_group_is_wilson() -> None:
    assert macro_wilson([(7, 10)]) == pytest.approx(wilson(7, 10), abs=1e-12)


def test_macro_interval_of_two_groups_by_hand() -> None:
    (low_a, high_a), (low_b, high_b) = wilson_formula(9, 10), wilson_formula(6, 20)
    low = 0.6 - 0.5 * math.hypot(0.9 - low_a, 0.3 - low_b)
    high = 0.6 + 0.5 * math.hypot(high_a - 0.9, high_b - 0.3)
    assert macro_wilson([(9, 10), (6, 20)]) == pytest.approx((low, high), abs=1e-12)


def test_macro_interval_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    truth, sizes = np.array([0.95, 0.7, 0.3]), np.array([20, 15, 10])
    draws = rng.binomial(sizes, truth, size=(600, 3))
    intervals = [macro_wilson(list(zip(successes, sizes, strict=True))) for successes in draws]
    inside = [low <= truth.mean() <= high for low, high in intervals]
    assert 0.92 <= np.mean(inside) <= 0.985


def test_paired_counts_are_the_four_cells() -> None:
    baseline = np.array([1, 1, 1, 0, 0, 0, 0], bool)
    method = np.array([1, 1, 0, 1, 1, 1, 0], bool)
    assert paired_counts(baseline, method) == PairedCounts(both=2, only_baseline=1, only_method=3, neither=1)


@pytest.mark.parametrize(("lost", "won"), [(0, 1), (3, 0), (11, 0), (5, 2), (4, 4), (1, 9)])
def test_mcnemar_is_twice_the_binomial_tail(lost: int, won: int) -> None:
    n = lost + won
    tail = sum(math.comb(n, k) for k in range(min(lost, won) + 1)) / 2**n
    assert mcnemar(PairedCounts(10, lost, won, 10)) == pytest.approx(min(1.0, 2 * tail), abs=1e-12)


def test_mcnemar_without_discordant_pairs_is_one() -> None:
    assert mcnemar(PairedCounts(5, 0, 0, 5)) == 1.0


def test_speedup_is_the_ratio_of_means_not_the_mean_of_ratios() -> None:
    found = speedup(np.array([1.0, 9.0]), np.array([1.0, 3.0]), ["a", "a"])
    assert found.value == pytest.approx(10 / 4)


def test_macro_speedup_weighs_groups_equally() -> None:
    baseline, method = np.array([2.0, 4.0, 6.0, 30.0, 34.0]), np.array([1.0, 2.0, 3.0, 20.0, 20.0])
    groups = ["easy", "easy", "easy", "hard", "hard"]
    found = speedup(baseline, method, ["a", "a", "a", "b", "b"], groups)
    assert found.value == pytest.approx((4.0 + 32.0) / (2.0 + 20.0))
    assert speedup(baseline, method, ["a", "a", "a", "b", "b"]).value == pytest.approx(76.0 / 46.0)


def slow_bootstrap(baseline: np.ndarray, method: np.ndarray, strata: list[str], draws: int) -> tuple[float, float]:
    rng = np.random.default_rng(99)
    names = sorted(set(strata))
    ratios = []
    for _ in range(draws):
        picked = [
            int(rng.choice([i for i, s in enumerate(strata) if s == name]))
            for name in names
            for _ in range(strata.count(name))
        ]
        ratios.append(baseline[picked].sum() / method[picked].sum())
    return tuple(np.quantile(ratios, [0.025, 0.975]))


def test_interval_agrees_with_a_bootstrap_written_as_loops() -> None:
    rng = np.random.default_rng(5)
    strata = ["a"] * 8 + ["b"] * 5
    baseline = rng.lognormal(0.0, 0.3, 13)
    method = baseline / 1.5 * rng.lognormal(0.0, 0.2, 13)
    found = speedup(baseline, method, strata)
    assert (found.low, found.high) == pytest.approx(slow_bootstrap(baseline, method, strata, 2000), rel=0.02)


def test_resampling_stays_within_tasks() -> None:
    """Tasks of very different cost, constant within: between-task resampling would give a wide interval."""
    baseline, method = np.array([1.0, 1.0, 100.0, 100.0]), np.array([1.0, 1.0, 50.0, 50.0])
    found = speedup(baseline, method, ["a", "a", "b", "b"])
    assert (found.low, found.high) == pytest.approx((found.value, found.value))


def test_pairs_stay_together() -> None:
    rng = np.random.default_rng(3)
    baseline = rng.lognormal(0.0, 1.0, 40)
    together = speedup(baseline, baseline / 2, ["a"] * 40)
    apart = speedup(baseline, rng.permutation(baseline / 2), ["a"] * 40)
    assert together.high - together.low < 1e-9 < 0.2 < apart.high - apart.low


def test_interval_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(11)
    inside = []
    for _ in range(300):
        shared = rng.lognormal(0.0, 0.3, 40)
        baseline, method = 1.6 * shared * rng.lognormal(0, 0.1, 40), shared * rng.lognormal(0, 0.1, 40)
        found = speedup(baseline, method, ["a"] * 20 + ["b"] * 20, resamples=800)
        inside.append(found.low <= 1.6 <= found.high)
    assert 0.90 <= np.mean(inside) <= 0.985


def slow_two_levels(baseline: np.ndarray, method: np.ndarray, blocks: list[str], draws: int) -> tuple[float, float]:
    """One stratum, as loops: blocks first, then the pairs of every drawn block."""
    rng = np.random.default_rng(99)
    names = sorted(set(blocks))
    ratios = []
    for _ in range(draws):
        picked: list[int] = []
        for name in rng.choice(names, len(names)):
            members = [i for i, block in enumerate(blocks) if block == name]
            picked += list(rng.choice(members, len(members)))
        ratios.append(baseline[picked].sum() / method[picked].sum())
    return tuple(np.quantile(ratios, [0.025, 0.975]))


def blocked_times(rng: np.random.Generator, sizes: list[int]) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Pairs whose ratio depends on their block: 1.6 on average."""
    blocks = [f"b{i}" for i, size in enumerate(sizes) for _ in range(size)]
    drift = np.repeat(rng.lognormal(0.0, 0.2, len(sizes)), sizes)
    method = rng.lognormal(0.0, 0.1, len(blocks))
    return 1.6 * drift * method * rng.lognormal(0.0, 0.05, len(blocks)), method, blocks


def test_two_level_interval_agrees_with_loops_for_blocks_of_any_size() -> None:
    baseline, method, blocks = blocked_times(np.random.default_rng(8), [5, 2, 4, 5, 1, 3])
    found = speedup(baseline, method, ["a"] * 20, blocks=blocks)
    assert (found.low, found.high) == pytest.approx(slow_two_levels(baseline, method, blocks, 3000), rel=0.02)


def test_what_drifts_from_block_to_block_widens_the_interval() -> None:
    baseline, method, blocks = blocked_times(np.random.default_rng(2), [5] * 8)
    known, unknown = speedup(baseline, method, ["a"] * 40, blocks=blocks), speedup(baseline, method, ["a"] * 40)
    assert known.value == unknown.value
    assert known.high - known.low > 1.5 * (unknown.high - unknown.low)


def test_two_level_interval_covers_the_truth_where_pairs_alone_would_not() -> None:
    rng = np.random.default_rng(21)
    truth = 1.6 * np.exp(0.2**2 / 2 + 0.05**2 / 2)
    inside = np.zeros(2)
    for _ in range(200):
        baseline, method, blocks = blocked_times(rng, [5] * 12)
        for i, known in enumerate((blocks, None)):
            found = speedup(baseline, method, ["a"] * 60, blocks=known, resamples=500)
            inside[i] += found.low <= truth <= found.high
    assert 0.86 <= inside[0] / 200 <= 0.99
    assert inside[1] / 200 < 0.75


@pytest.mark.bits
def test_same_numbers_every_time() -> None:
    rng = np.random.default_rng(1)
    baseline, method = rng.uniform(1, 2, 9), rng.uniform(1, 2, 9)
    assert speedup(baseline, method, ["a"] * 9) == speedup(baseline, method, ["a"] * 9)


def test_one_pair_per_task_has_no_interval() -> None:
    found = speedup(np.array([2.0, 4.0]), np.array([1.0, 2.0]), ["a", "b"])
    assert found.value == 2.0
    assert math.isnan(found.low)
    assert math.isnan(found.high)


def test_without_pairs_there_is_no_speedup() -> None:
    assert math.isnan(speedup(np.array([]), np.array([]), []).value)


@pytest.mark.parametrize(("successes", "episodes"), [(0, 7), (12, 12), (3, 8), (187, 200)])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
def test_wilson_is_statsmodels(successes: int, episodes: int, confidence: float) -> None:
    expected = proportion_confint(successes, episodes, 1 - confidence, method="wilson")
    assert wilson(successes, episodes, confidence) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("counts", [(10, 0, 0, 3), (10, 5, 2, 3), (150, 13, 4, 33), (0, 9, 1, 0)])
def test_mcnemar_is_statsmodels(counts: tuple[int, int, int, int]) -> None:
    both, lost, won, neither = counts
    expected = statsmodels_mcnemar([[both, lost], [won, neither]], exact=True).pvalue
    assert mcnemar(PairedCounts(*counts)) == pytest.approx(min(1.0, expected), abs=1e-12)


def test_paired_difference_by_hand() -> None:
    """Of 50 pairs the method solves 36 + 2, the baseline 36 + 12, none solves 0."""
    low_a, high_a = wilson_formula(38, 50)
    low_b, high_b = wilson_formula(48, 50)
    phi = (36 * 0 - 12 * 2) / math.sqrt(38 * 12 * 48 * 2)  # below 0: without the correction for continuity
    below, above = 0.76 - low_a, high_b - 0.96
    low = -0.2 - math.sqrt(below**2 - 2 * phi * below * above + above**2)
    below, above = high_a - 0.76, 0.96 - low_b
    high = -0.2 + math.sqrt(below**2 - 2 * phi * below * above + above**2)
    assert paired_difference(PairedCounts(36, 12, 2, 0)) == pytest.approx((-0.2, low, high), abs=1e-9)


def test_paired_difference_of_correlated_pairs_by_hand() -> None:
    low_a, high_a = wilson_formula(24, 40)
    low_b, high_b = wilson_formula(22, 40)
    phi = (20 * 14 - 2 * 4 - 20) / math.sqrt(24 * 16 * 22 * 18)  # less half the pairs, for continuity
    below, above = 0.6 - low_a, high_b - 0.55
    low = 0.05 - math.sqrt(below**2 - 2 * phi * below * above + above**2)
    below, above = high_a - 0.6, 0.55 - low_b
    high = 0.05 + math.sqrt(below**2 - 2 * phi * below * above + above**2)
    assert paired_difference(PairedCounts(20, 2, 4, 14)) == pytest.approx((0.05, low, high), abs=1e-9)


@pytest.mark.parametrize(
    "counts", [(0, 0, 0, 5), (5, 0, 0, 0), (3, 4, 0, 0), (20, 2, 4, 14), (0, 3, 9, 0), (1, 0, 0, 0)]
)
def test_paired_difference_is_symmetric_and_bounded(counts: tuple[int, int, int, int]) -> None:
    both, lost, won, neither = counts
    value, low, high = paired_difference(PairedCounts(both, lost, won, neither))
    assert -1 <= low <= value <= high <= 1
    assert low < high
    swapped = paired_difference(PairedCounts(both, won, lost, neither))
    assert swapped == pytest.approx((-value, -high, -low), abs=1e-12)
    failures = paired_difference(PairedCounts(neither, won, lost, both))  # counted instead of successes
    assert failures == pytest.approx((-value, -high, -low), abs=1e-12)


@pytest.mark.parametrize("rates", [(0.85, 0.05, 0.02, 0.08), (0.5, 0.2, 0.1, 0.2), (0.9, 0.03, 0.03, 0.04)])
def test_paired_difference_covers_the_truth_as_often_as_it_says(rates: tuple[float, ...]) -> None:
    draws = np.random.default_rng(7).multinomial(60, rates, size=800)
    intervals = [paired_difference(PairedCounts(*map(int, counts))) for counts in draws]
    inside = [found.low <= rates[2] - rates[1] <= found.high for found in intervals]
    assert np.mean(inside) >= 0.93


def test_without_pairs_there_is_no_difference() -> None:
    assert all(math.isnan(number) for number in paired_difference(PairedCounts(0, 0, 0, 0)))
    assert math.isnan(pairs_to_settle(PairedCounts(0, 0, 0, 0), 0.03))


@pytest.mark.parametrize(
    ("counts", "pairs"),
    [
        ((80, 5, 5, 10), math.ceil(1.96**2 * 0.1 / 0.03**2)),  # no difference, a tenth discordant: 427
        ((80, 6, 4, 10), math.ceil(1.96**2 * (0.1 - 0.02**2) / 0.01**2)),  # two points worse: 3827
        ((80, 4, 6, 10), math.ceil(1.96**2 * (0.1 - 0.02**2) / 0.05**2)),
        ((80, 0, 0, 20), math.ceil(1.96**2 * 0.01 / 0.03**2)),  # one discordant pair is assumed
        ((80, 10, 5, 5), math.inf),  # five points worse: no number of pairs shows it
    ],
)
def test_pairs_to_settle_by_hand(counts: tuple[int, int, int, int], pairs: float) -> None:
    assert pairs_to_settle(PairedCounts(*counts), 0.03) == pairs


def test_pairs_to_settle_are_enough() -> None:
    """With so many pairs of the same rates the normal interval's lower bound lies at the margin, no further."""
    counts, margin = np.array([80, 6, 5, 9]), 0.03
    needed = pairs_to_settle(PairedCounts(*map(int, counts)), margin)
    low, short = (-0.01 - 1.96 * math.sqrt((0.11 - 0.01**2) / pairs) for pairs in (needed, needed - 1))
    assert short < -margin <= low
