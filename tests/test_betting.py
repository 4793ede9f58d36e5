"""Tests of means by betting: how often they err, and what they show."""

import math

import numpy as np
import pytest

from kerv_cli.methods.certified.betting import more_to_decide, p_value, wealth


def lost_and_won(random: np.random.Generator, pairs: int, lost: float, won: float) -> np.ndarray:
    """v of paired episodes of which these shares are solved by the baseline, by the method alone."""
    return random.choice([1.0, 0.5, 0.0], size=pairs, p=[lost, 1 - lost - won, won])


@pytest.mark.parametrize("groups", [1, 10])
def test_a_bet_against_a_true_hypothesis_errs_no_oftener_than_it_says(groups):
    """Means at the bound: skewed ones, two-point ones, those of tasks that differ in random order, and of pairs."""
    random, bound = np.random.default_rng(0), 0.1
    hard = np.repeat(np.linspace(0, 2 * bound, groups) if groups > 1 else [bound], 200 // groups)

    def share(draw, at=bound):
        return float(np.mean([p_value(draw(), at, 0.1) <= 0.1 for _ in range(400)]))

    most = 0.1 + 3 * math.sqrt(0.09 / 400)
    assert share(lambda: random.permutation(random.beta(0.2 * hard + 1e-9, 0.2 * (1 - hard)))) <= most
    assert share(lambda: (random.random(200) < random.permutation(hard)).astype(float)) <= most
    for lost, won in ((0.05, 0.0), (0.08, 0.03), (0.15, 0.1)):
        assert share(lambda lost=lost, won=won: lost_and_won(random, 210, lost, won), 0.525) <= most  # type: ignore[misc]


def test_bets_show_that_pairs_that_seldom_differ_lose_less_than_five_points():
    random = np.random.default_rng(1)
    shown = [p_value(lost_and_won(random, 210, 0.01, 0.01), 0.525, 0.1) <= 0.1 for _ in range(300)]
    assert np.mean(shown) >= 0.95


def test_bets_know_nothing_of_the_values_to_come():
    values = np.random.default_rng(2).random(30)
    changed = np.concatenate([values[:20], 1 - values[20:]])
    assert wealth(values, 0.5, 0.1)[:20] == pytest.approx(wealth(changed, 0.5, 0.1)[:20])
    assert p_value(np.zeros(0), 0.5, 0.1) == 1.0


def test_how_many_values_more_would_decide():
    """Pairs that agree: each multiplies the wealth by as much, so that the number is exact up to the first bets."""
    short = np.full(60, 0.5)
    more = more_to_decide(short, 0.525, 0.1)
    growth = math.log1p(0.75 / 0.475 * 0.025)
    assert more == math.ceil((math.log(10) - math.log(wealth(short, 0.525, 0.1)[-1])) / growth)
    assert more_to_decide(np.full(200, 0.5), 0.525, 0.1) == 0
    assert more_to_decide(np.full(60, 0.6), 0.525, 0.1) == math.inf
    assert more_to_decide(np.zeros(0), 0.525, 0.1) == math.inf
