"""Which setting to take, and when a sweep has measured enough."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from studies_synthetic import settings_of, study_of, swept

from kerv_cli.base.errors import UsageError
from kerv_cli.lab.study import looks_of
from kerv_cli.report import decide
from kerv_cli.report.decide import (
    LARGER,
    OPEN,
    SMALLER,
    choices,
    confidence_of_a_look,
    pareto,
    safest_first,
    sentence,
    short_sentence,
    verdict_of,
)
from kerv_cli.report.measures import MICRO
from kerv_cli.report.statistics import PairedCounts, paired_difference, pairs_to_settle, ratio
from kerv_cli.report.tables import load_study, rows_of


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
        "success": (counts.both + counts.only_method) / pairs,
        "pairs": pairs,
        "difference_low": found.low,
        **counts._asdict(),
    }


@pytest.fixture
def table() -> pd.DataFrame:
    rows = [
        row("ar", 1.0, PairedCounts(190, 0, 0, 10), 4),
        row("slow", 0.8, PairedCounts(150, 40, 0, 10), 3),
        row("r=9", 1.5, PairedCounts(188, 2, 2, 8), 0.6),
        row("r=3", 1.3, PairedCounts(189, 1, 1, 9), 1.2),
        row("r=20", 1.9, PairedCounts(170, 20, 1, 9), 0.5),
        row("unverified", 5.0, PairedCounts(190, 0, 0, 10), 0.0, 1.0),
    ]
    return pd.DataFrame(rows)


def test_the_fastest_setting_before_the_first_that_is_not_shown_is_chosen(table: pd.DataFrame) -> None:
    """`slow` fails and is no answer; `unverified` would pass, but comes behind `r=20`, which does not."""
    assert [r["label"] for r in safest_first(rows_of(table))] == ["r=3", "r=9", "r=20", "unverified"]
    found = choices(table, table.assign(task="reach"), 4.0)
    assert [choice.where for choice in found] == ["all tasks", "reach"]
    assert found[0].chosen == "r=9"
    assert found[0].front == ("unverified",)
    assert sentence(found[0], 4.0, "ar") == (
        "the fastest setting that loses less than 4 points of success against ar, with 95 % confidence: r=9, per "
        "episode 1.50 (1.40–1.60) times as fast as ar on this machine (200 pairs)"
    )
    assert short_sentence(found[1]) == "reach: r=9"


def test_what_is_not_shown_yet_says_how_many_episodes_more_would_do(table: pd.DataFrame) -> None:
    """Of r = 9, the fastest that may be non-inferior: behind r = 20, which loses more than the bound, nothing is."""
    found = choices(table, table.iloc[:0], 2.0)[0]
    assert (found.chosen, found.candidate) == ("", "r=9")
    assert found.candidate_pairs == pairs_to_settle(PairedCounts(188, 2, 2, 8), 0.02) > 200
    assert "more would show it for r=9" in sentence(found, 2.0, "ar")
    slower = choices(table[table["label"].isin(["ar", "slow"])], None, 2.0)[0]
    assert sentence(slower, 2.0, "ar") == "no setting is faster per episode than ar (200 pairs)"
    far = dataclasses.replace(found, candidate_pairs=110_128.0)
    assert sentence(far, 2.0, "ar").endswith("; more than 10,000 pairs would be needed to show it for r=9")
    worse = choices(table[table["label"].isin(["ar", "r=20"])], table.iloc[:0], 2.0)[0]
    assert sentence(worse, 2.0, "ar").endswith("more would not show one")


def test_untimed_settings_are_chosen_by_the_order_of_the_tests(table: pd.DataFrame) -> None:
    untimed = table[table["label"] != "r=20"].assign(episode_speedup=math.nan, episode_speedup_low=math.nan)
    found = choices(untimed[untimed["label"] != "slow"], table.iloc[:0], 4.0)[0]
    assert found.chosen == "unverified"
    assert sentence(found, 4.0, "ar") == (
        "unverified loses less than 4 points of success against ar, with 95 % confidence (200 pairs); which setting is "
        "the fastest was not timed"
    )


def test_ten_settings_at_the_bound_are_seldom_chosen() -> None:
    """Ten settings that lose exactly the bound, a tenth of the pairs discordant; each tested by itself, one looks safe
    in a fifth of the studies."""
    random, chosen, studies = np.random.default_rng(0), 0, 300
    for _ in range(studies):
        draws = random.multinomial(200, (0.85, 0.065, 0.035, 0.05), size=10)
        rows = [row(f"s{i}", 1.1 + i, PairedCounts(*map(int, counts)), 1 - i / 20) for i, counts in enumerate(draws)]
        rows.append(row("ar", 1.0, PairedCounts(190, 0, 0, 10), 4))
        chosen += bool(choices(pd.DataFrame(rows), pd.DataFrame(columns=["task"]), 3.0)[0].chosen)
    assert chosen / studies <= 0.05


def test_the_pareto_front_keeps_ties_and_drops_what_is_beaten_in_both() -> None:
    rows = [
        {"label": name, "baseline": "ar", "episode_speedup": speed, "success": success}
        for name, speed, success in (("ar", 1.0, 0.9), ("a", 2.0, 0.9), ("b", 2.0, 0.8), ("c", 3.0, 0.5))
    ]
    assert [r["label"] for r in pareto(rows)] == ["c", "a"]


@pytest.mark.parametrize("looks", [2, 4, 10])
def test_the_boundary_misjudges_one_time_in_twenty_over_all_looks(looks: int) -> None:
    steps = np.random.default_rng(0).normal(size=(200_000, looks))
    z = steps.cumsum(axis=1) / np.sqrt(np.arange(1, looks + 1))
    from scipy.stats import norm

    bound = norm.ppf(0.5 + confidence_of_a_look(looks) / 2)
    assert (np.abs(z) > bound).any(axis=1).mean() == pytest.approx(0.05, abs=0.003)


def test_more_looks_than_are_tabled_are_refused() -> None:
    with pytest.raises(UsageError, match=r"set study\.block higher"):
        confidence_of_a_look(21)


def test_a_setting_is_open_until_its_interval_leaves_the_bound() -> None:
    assert verdict_of("a", PairedCounts(5, 0, 0, 0), 0.03, 1, 4).verdict == OPEN
    assert verdict_of("a", PairedCounts(950, 5, 5, 40), 0.03, 1, 4).verdict == SMALLER
    assert verdict_of("a", PairedCounts(500, 400, 0, 100), 0.03, 1, 4).verdict == LARGER


def test_verdicts_come_from_the_stored_pairs_and_are_stored(tmp_path: Path) -> None:
    settings = {"ar": settings_of("ar", episodes=4), "spec_vla": settings_of("spec_vla", 9, 4)}
    study = study_of(settings, ["reach-v3"], block=2)
    store, _ = swept(tmp_path, study)
    assert [len(look) for look in looks_of(study)] == [4, 4]
    (found,) = decide.verdicts(load_study(store), ["spec_vla"], 0.5, 2, 2)
    assert found.pairs == 4
    decide.write_verdicts(store.root, {"spec_vla": found}, 50.0, 2)
    assert json.loads((store.root / "decided.json").read_text())["loss_points"] == 50.0
    again = decide.read_verdicts(store.root)
    assert again is not None
    assert list(again["label"]) == ["spec_vla"]


def test_the_interval_of_a_ratio_covers_it() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(400):
        below = rng.integers(5, 30, size=60)
        above = rng.binomial(below * 16, 0.5)
        found = ratio(above, below)
        hits += found.low <= 8.0 <= found.high
    assert hits / 400 == pytest.approx(0.95, abs=0.03)


def test_the_interval_of_a_ratio_covers_it_with_few_episodes_among_many_that_say_nothing() -> None:
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(400):
        below = np.concatenate([rng.integers(5, 9, size=4), np.zeros(40)])
        above = np.concatenate([rng.normal(0.3 * below[:4], 1.0), np.zeros(40)])
        found = ratio(above, below)
        hits += found.low <= 0.3 <= found.high
    assert hits / 400 == pytest.approx(0.95, abs=0.03)


def test_one_episode_gives_a_ratio_no_interval() -> None:
    assert math.isnan(ratio(np.array([3]), np.array([2])).low)
    assert math.isnan(ratio(np.array([3, 0, 0]), np.array([2, 0, 0])).high)
