"""Which setting to take."""

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
import pytest

from kerv_cli.report.measures import Measures, Result
from kerv_cli.report.statistics import NO_ESTIMATE, Estimate, PairedCounts, paired_difference, pairs_to_settle, wilson
from kerv_cli.report.verdict import (
    choose,
    order_of,
    safest_first,
    sentence,
    verdict_of,
)

T = TypeVar("T", Measures, Result)
UNKNOWN = {"str": "", "int": 0, "bool": False, "float": math.nan, "Estimate": NO_ESTIMATE}


def with_fields(kind: type[T], **known: Any) -> T:
    """A dataclass with the known fields; the others say nothing."""
    return kind(**{one.name: known.get(one.name, UNKNOWN.get(str(one.type), {})) for one in fields(kind)})


def row(
    label: str,
    speedup: float,
    counts: PairedCounts,
    forwards: float = 1.0,
    unverified: float = 0.0,
    method: str = "",
) -> Result:
    measures = with_fields(
        Measures,
        episode_speedup=Estimate(speedup, speedup - 0.1, speedup + 0.1),
        forwards_per_step=forwards,
        unverified_share=unverified,
        success=wilson(counts.both + counts.only_method, sum(counts)),
        counts=counts,
        difference=paired_difference(counts),
    )
    about = {"task": "all", "tasks": 1, "runs": 1, "method": method}
    return with_fields(Result, label=label, baseline="ar", measures=measures, **about)


def at_speed(result: Result, speed: Estimate) -> Result:
    return replace(result, measures=replace(result.measures, episode_speedup=speed))


def only(rows: Sequence[Result], *labels: str) -> list[Result]:
    return [one for one in rows if one.label in labels]


@pytest.fixture
def rows():
    return [
        row("ar", 1.0, PairedCounts(190, 0, 0, 10), 4, method="ar"),
        row("slow", 0.8, PairedCounts(150, 40, 0, 10), 3, method="naive_sd"),
        row("r=9", 1.5, PairedCounts(188, 2, 2, 8), 0.6, method="spec_vla"),
        row("r=3", 1.3, PairedCounts(189, 1, 1, 9), 1.2, method="spec_vla"),
        row("r=20", 1.9, PairedCounts(170, 20, 1, 9), 0.5, method="spec_vla"),
        row("unverified", 5.0, PairedCounts(190, 0, 0, 10), 0.0, 1.0, method="early_unverified"),
    ]


def test_the_fastest_setting_before_the_first_that_fails_is_chosen(rows):
    """`slow` fails and is no answer; `unverified` would pass, but comes after `r=20`, which does not."""
    assert [one.label for one in safest_first(rows)] == ["r=3", "r=9", "r=20", "unverified"]
    whole = choose(rows, 4.0)
    assert (whole.chosen, whole.is_shown) == ("r=9", True)
    assert sentence(whole, 4.0, "ar") == (
        "r=9 loses less than 4 points of success against ar (95 % confidence, 200 pairs) and is faster: "
        "1.50 (1.40–1.60 of this run) times as fast per episode on this machine"
    )


def test_a_setting_is_called_faster_only_if_its_interval_is_above_one(rows):
    wide = [at_speed(one, Estimate(1.5, 0.9, 1.6)) for one in only(rows, "r=9")]
    wide += only(rows, "ar")
    found = choose(wide, 4.0)
    assert (found.chosen, found.is_shown) == ("r=9", False)
    assert "but is not shown to be faster: 1.50 (0.90–" in sentence(found, 4.0, "ar")
    assert choose([*wide, *only(rows, "r=3")], 4.0).chosen == "r=3"


def test_nothing_is_recommended_where_the_baseline_does_not_solve_the_tasks():
    rows = [row("ar", 1.0, PairedCounts(30, 0, 0, 170), 4), row("r=9", 2.0, PairedCounts(30, 0, 0, 170))]
    whole = choose(rows, 4.0)
    assert (whole.chosen, whole.candidate, whole.is_shown) == ("", "", False)
    assert sentence(whole, 4.0, "ar").startswith("ar does not solve these tasks (15 % of its episodes succeed)")


def test_the_order_by_speed_says_which_neighbours_cannot_be_told_apart():
    by_speed = [("c", Estimate(1.5, 1.4, 1.6)), ("b", Estimate(1.1, 0.9, 1.3)), ("a", NO_ESTIMATE)]
    assert order_of(by_speed) == "c > b ≈ a (≈: these episodes cannot tell the two apart)"
    assert order_of(by_speed[:1]) == "c"
    assert order_of([]) == ""


def test_what_is_not_shown_yet_says_how_many_pairs_more_would_do(rows):
    """Of r = 9, the fastest that may be non-inferior: nothing after r = 20 is, which loses more than the bound."""
    found = choose(rows, 2.0)
    assert (found.chosen, found.candidate) == ("", "r=9")
    assert found.candidate_pairs == pairs_to_settle(PairedCounts(188, 2, 2, 8), 0.02) > 200
    said = sentence(found, 2.0, "ar")
    assert "the fastest setting that may keep the success is r=9: 1.50 (1.40–1.60 of this run) times as fast" in said
    assert said.endswith("more pairs would show it for r=9")
    assert verdict_of(rows, 2.0).episodes == math.ceil(found.candidate_pairs)
    assert verdict_of(rows, 4.0).episodes == 0, "a setting is named already"
    assert choose(rows, 0.5).candidate_pairs > 10 * 200
    assert verdict_of(rows, 0.5).episodes == 0, "more than ten times what ran is no advice"
    slower = choose(only(rows, "ar", "slow"), 2.0)
    assert sentence(slower, 2.0, "ar") == "no setting is shown to be faster per episode than ar (200 pairs)"
    far = replace(found, candidate_pairs=110_128.0)
    assert sentence(far, 2.0, "ar").endswith("more than 10,000 more pairs would show it for r=9")
    worse = choose(only(rows, "ar", "r=20"), 2.0)
    assert sentence(worse, 2.0, "ar").endswith("more pairs would not show one either")


def test_untimed_settings_are_chosen_by_the_order_of_the_tests(rows):
    untimed = [at_speed(one, NO_ESTIMATE) for one in only(rows, "ar", "r=9", "r=3", "unverified")]
    found = choose(untimed, 4.0)
    assert (found.chosen, found.is_shown) == ("unverified", False)
    assert sentence(found, 4.0, "ar").endswith("; its speed was not measured")


def test_a_setting_without_a_measured_speed_is_not_called_the_fastest(rows):
    """One value was added to a finished study: it was not timed in turn, every other setting is slower than ar."""
    added = at_speed(row("r=15", 1.0, PairedCounts(180, 10, 5, 5), 0.55, method="spec_vla"), NO_ESTIMATE)
    found = choose([*only(rows, "ar", "slow"), added], 2.0)
    assert (found.chosen, found.candidate, found.untimed) == ("", "", ("r=15",))
    said = sentence(found, 2.0, "ar")
    assert said == "no setting is shown to be faster per episode than ar (200 pairs); without a measured speed: r=15"
    faster = choose([*only(rows, "ar", "slow", "r=9"), added], 4.0)
    assert (faster.chosen, faster.untimed) == ("r=9", ("r=15",))


def test_ten_settings_at_the_bound_are_seldom_chosen():
    """Ten settings that lose exactly the bound, a tenth of the pairs discordant; each tested by itself, one looks safe
    in a fifth of the studies."""
    random, chosen, studies = np.random.default_rng(0), 0, 300
    for _ in range(studies):
        draws = random.multinomial(200, (0.85, 0.065, 0.035, 0.05), size=10)
        rows = [row(f"s{i}", 1.1 + i, PairedCounts(*map(int, counts)), 1 - i / 20) for i, counts in enumerate(draws)]
        rows.append(row("ar", 1.0, PairedCounts(190, 0, 0, 10), 4))
        chosen += bool(choose(rows, 3.0).chosen)
    assert chosen / studies <= 0.05
