"""Which setting to take."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest

from kerv_cli.report.decide import choices, pareto, safest_first
from kerv_cli.report.matched import with_matched_speed
from kerv_cli.report.measures import MICRO
from kerv_cli.report.statistics import PairedCounts, paired_difference, pairs_to_settle
from kerv_cli.report.tables import rows_of
from kerv_cli.report.verdict import sentence, short_sentence


def row(
    label: str, speedup: float, counts: PairedCounts, forwards: float = 1.0, unverified: float = 0.0
) -> dict[str, object]:
    found = paired_difference(counts)
    pairs = sum(counts)
    return {
        "averaging": MICRO,
        "label": label,
        "baseline": "ar",
        "task": "all",
        "episode_speedup": speedup,
        "episode_speedup_low": speedup - 0.1,
        "episode_speedup_high": speedup + 0.1,
        "forwards_per_step": forwards,
        "unverified_share": unverified,
        "runs": 1,
        "success": (counts.both + counts.only_method) / pairs,
        "pairs": pairs,
        "difference_low": found.low,
        **counts._asdict(),
    }


@pytest.fixture
def table():
    rows = [
        row("ar", 1.0, PairedCounts(190, 0, 0, 10), 4),
        row("slow", 0.8, PairedCounts(150, 40, 0, 10), 3),
        row("r=9", 1.5, PairedCounts(188, 2, 2, 8), 0.6),
        row("r=3", 1.3, PairedCounts(189, 1, 1, 9), 1.2),
        row("r=20", 1.9, PairedCounts(170, 20, 1, 9), 0.5),
        row("unverified", 5.0, PairedCounts(190, 0, 0, 10), 0.0, 1.0),
    ]
    return pd.DataFrame(rows)


def test_the_fastest_setting_before_the_first_that_fails_is_chosen(table):
    """`slow` fails and is no answer; `unverified` would pass, but comes after `r=20`, which does not."""
    assert [r["label"] for r in safest_first(rows_of(table))] == ["r=3", "r=9", "r=20", "unverified"]
    whole, reach = choices(table, table.assign(task="reach"), 4.0)
    assert (whole.where, reach.where) == ("all tasks", "reach")
    assert (whole.chosen, whole.front, whole.is_shown) == ("r=9", ("unverified",), True)
    assert sentence(whole, 4.0, "ar") == (
        "r=9 loses less than 4 points of success against ar (95 % confidence, 200 pairs) and is faster: "
        "1.50 (1.40–1.60 of this run) times as fast per episode on this machine"
    )
    assert short_sentence(reach) == "reach: r=9"


def test_the_matched_success_speed_of_a_method_is_that_of_its_fastest_setting_that_keeps_success(table):
    """Of r = 3, 9 and 20, the last loses too much. `unverified` is another method. Where AR fails, there is none."""
    methods = {"ar": "ar", "unverified": "early_unverified", "slow": "naive_sd"}
    rows = rows_of(table.assign(method=[methods.get(label, "spec_vla") for label in table["label"]]))
    found = {row["label"]: row["matched_success_speed"] for row in with_matched_speed(rows)}
    assert (found["r=3"], found["r=9"], found["r=20"], found["unverified"]) == (1.5, 1.5, 1.5, 5.0)
    assert math.isnan(found["slow"])
    assert math.isnan(found["ar"])
    failing = [row | {"success": 0.19} for row in rows]
    assert all(math.isnan(row["matched_success_speed"]) for row in with_matched_speed(failing))


def test_a_setting_is_called_faster_only_if_its_interval_is_above_one(table):
    wide = table[table["label"].isin(["ar", "r=9"])].assign(episode_speedup_low=0.9)
    (found,) = choices(wide, table.iloc[:0], 4.0)
    assert (found.chosen, found.is_shown) == ("r=9", False)
    assert "but is not shown to be faster: 1.50 (0.90–" in sentence(found, 4.0, "ar")
    with_narrow = pd.concat([wide, table[table["label"] == "r=3"]])
    assert choices(with_narrow, table.iloc[:0], 4.0)[0].chosen == "r=3"


def test_nothing_is_recommended_where_the_baseline_does_not_solve_the_tasks():
    rows = [row("ar", 1.0, PairedCounts(30, 0, 0, 170), 4), row("r=9", 2.0, PairedCounts(30, 0, 0, 170))]
    whole, reach = choices(pd.DataFrame(rows), pd.DataFrame(rows).assign(task="reach"), 4.0)
    assert (whole.chosen, whole.candidate, whole.front, whole.is_shown) == ("", "", (), False)
    assert sentence(whole, 4.0, "ar").startswith("ar does not solve these tasks (15 % of its episodes succeed)")
    assert "does not solve" in short_sentence(reach)


def test_what_is_not_shown_yet_says_how_many_pairs_more_would_do(table):
    """Of r = 9, the fastest that may be non-inferior: nothing after r = 20 is, which loses more than the bound."""
    found = choices(table, table.iloc[:0], 2.0)[0]
    assert (found.chosen, found.candidate) == ("", "r=9")
    assert found.candidate_pairs == pairs_to_settle(PairedCounts(188, 2, 2, 8), 0.02) > 200
    assert "more pairs would show it for r=9" in sentence(found, 2.0, "ar")
    slower = choices(table[table["label"].isin(["ar", "slow"])], table.iloc[:0], 2.0)[0]
    assert sentence(slower, 2.0, "ar") == "no setting is shown to be faster per episode than ar (200 pairs)"
    far = dataclasses.replace(found, candidate_pairs=110_128.0)
    assert sentence(far, 2.0, "ar").endswith("more than 10,000 more pairs would show it for r=9")
    worse = choices(table[table["label"].isin(["ar", "r=20"])], table.iloc[:0], 2.0)[0]
    assert sentence(worse, 2.0, "ar").endswith("more pairs would not show one either")


def test_untimed_settings_are_chosen_by_the_order_of_the_tests(table):
    untimed = table[~table["label"].isin(["r=20", "slow"])].assign(
        episode_speedup=math.nan, episode_speedup_low=math.nan
    )
    found = choices(untimed, table.iloc[:0], 4.0)[0]
    assert (found.chosen, found.is_shown) == ("unverified", False)
    assert sentence(found, 4.0, "ar").endswith("; its speed was not measured")


def test_ten_settings_at_the_bound_are_seldom_chosen():
    """Ten settings that lose exactly the bound, a tenth of the pairs discordant; each tested by itself, one looks safe
    in a fifth of the studies."""
    random, chosen, studies = np.random.default_rng(0), 0, 300
    for _ in range(studies):
        draws = random.multinomial(200, (0.85, 0.065, 0.035, 0.05), size=10)
        rows = [row(f"s{i}", 1.1 + i, PairedCounts(*map(int, counts)), 1 - i / 20) for i, counts in enumerate(draws)]
        rows.append(row("ar", 1.0, PairedCounts(190, 0, 0, 10), 4))
        chosen += bool(choices(pd.DataFrame(rows), pd.DataFrame(columns=["task"]), 3.0)[0].chosen)
    assert chosen / studies <= 0.05


def test_the_pareto_front_keeps_ties_and_drops_what_is_beaten_in_both():
    rows = [
        {"label": name, "baseline": "ar", "episode_speedup": speed, "success": success}
        for name, speed, success in (("ar", 1.0, 0.9), ("a", 2.0, 0.9), ("b", 2.0, 0.8), ("c", 3.0, 0.5))
    ]
    assert [r["label"] for r in pareto(rows)] == ["c", "a"]
