"""Thresholds against their closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kerv_cli.config import compose
from kerv_cli.decoding.thresholds import Threshold, build_threshold
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.settings import RolloutSettings, ThresholdSettings

levels = st.floats(0, 50)


def threshold(kind: str, **values: Any) -> Threshold:
    return build_threshold(ThresholdSettings(kind, **{"k_s": 0.4, **values}))


def radius_after(built: Threshold, *variability: float | None) -> int:
    for value in variability:
        built.update(value)
    return built.radius()


def rounded(r: float) -> int:
    return math.floor(r + 0.5)


@settings(deadline=None)  # the machine is shared
@given(levels, st.floats(0.01, 5), st.floats(0.5, 4))
def test_kinematic_is_the_level_form(k: float, k_s: float, phi: float) -> None:
    r = radius_after(threshold("kinematic", k_s=k_s, phi=phi), k)
    exact = 5 + 10 * math.exp(-((k / k_s) ** phi))
    assert abs(r - exact) <= 0.5 + 1e-9


def test_kinematic_at_its_landmarks() -> None:
    built = threshold("kinematic")
    assert built.radius() == rounded(5 + 10 / math.e) == 9  # an episode begins at the reference level
    assert radius_after(built, 0.0) == 15
    assert radius_after(built, 0.4) == 9
    assert radius_after(built, 1e300) == 5
    assert radius_after(built, None) == 5  # nothing was compared: r stays
    built.reset()
    assert built.radius() == 9


@settings(deadline=None)  # the machine is shared
@given(levels, levels, st.floats(0, 10))
def test_more_variability_never_widens(k: float, more: float, start: float) -> None:
    for kind in ("kinematic", "change"):
        low = radius_after(threshold(kind), start, k)
        assert radius_after(threshold(kind), start, k + more) <= low


def test_change_is_its_closed_form() -> None:
    built = threshold("change")
    r, last = 5 + 10 * math.exp(-1), 0.4
    assert built.radius() == rounded(r)
    for k in (0.5, 0.45, None, 0.2, 0.1, 0.9, 0.0):
        if k is not None:
            move = 10 * (1 - math.exp(-((abs(k - last) / 0.4) ** 2)))
            r = min(15.0, max(5.0, r - move if k > last else r + move))
            last = k
        assert radius_after(built, k) == rounded(r)
    built.reset()
    assert built.radius() == 9


@settings(deadline=None)  # the machine is shared
@given(st.lists(levels, max_size=20), levels)
def test_change_moves_against_the_change_and_stays_in_range(history: list[float], k: float) -> None:
    built = threshold("change")
    before, last = radius_after(built, *history), history[-1] if history else 0.4
    after = radius_after(built, k)
    assert 5 <= after <= 15
    if k > last:
        assert after <= before
    elif k < last:
        assert after >= before
    else:
        assert after == before


def test_schedule_is_the_public_codes_and_open_loop() -> None:
    settings = compose("rollout", ["threshold=schedule", "threshold.tau=8"], RolloutSettings).threshold
    built, other = build_threshold(settings), build_threshold(settings)
    for t in range(40):
        assert built.radius() == other.radius() == rounded(3 + 12 * math.exp(-((t / 8) ** 3)))
        built.update(0.7)
        other.update(None)
    built.reset()
    assert built.radius() == 15


def test_fixed_ignores_what_happens() -> None:
    assert radius_after(threshold("fixed", r=9), 0.0, 9.0, None) == 9


@pytest.mark.parametrize("kind", ["fixed", "kinematic", "change", "schedule"])
def test_the_config_is_the_paper(kind: str) -> None:
    settings = compose("rollout", [f"threshold={kind}"], RolloutSettings).threshold
    assert settings.kind == kind
    if kind in ("kinematic", "change"):
        assert (settings.r_min, settings.r_max, settings.phi, settings.k_s) == (5, 15, 2.0, None)
        build_threshold(replace(settings, k_s=0.3))
    else:
        build_threshold(settings)


@pytest.mark.parametrize(
    ("kind", "values", "says"),
    [
        ("fixed", {"r": -1}, r"threshold\.r=-1"),
        ("fixed", {"r": 255}, r"threshold\.r=255"),
        ("kinematic", {"k_s": None}, "run 'kerv calibrate'"),
        ("change", {"k_s": None}, "run 'kerv calibrate'"),
        ("kinematic", {"k_s": 0.0}, r"threshold\.k_s=0\.0"),
        ("kinematic", {"k_s": math.nan}, r"threshold\.k_s=nan"),
        ("kinematic", {"k_s": math.inf}, r"threshold\.k_s=inf"),
        ("kinematic", {"r_min": 16}, r"threshold\.r_min=16 threshold\.r_max=15"),
        ("change", {"r_min": -1}, r"threshold\.r_min=-1"),
        ("schedule", {"r_max": 255}, r"threshold\.r_max=255"),
        ("kinematic", {"phi": 0.0}, r"threshold\.phi=0"),
        ("schedule", {"phi": -1.0}, r"threshold\.phi=-1"),
        ("schedule", {"tau": 0.0}, r"threshold\.tau=0"),
    ],
)
def test_bad_values_get_one_line(kind: str, values: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says) as caught:
        threshold(kind, **values)
    assert "\n" not in str(caught.value)


def test_an_unknown_kind_lists_the_known_ones() -> None:
    with pytest.raises(UnknownName, match="did you mean kinematic"):
        threshold("kinematik")
