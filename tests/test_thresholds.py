"""Thresholds against their closed forms."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kerv_cli.base.config import compose
from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_settings
from kerv_cli.base.registry import find
from kerv_cli.engine.parts import Threshold
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.context import Context
from kerv_cli.worlds.metaworld.spec import SPEC

levels = st.floats(0, 50)
CLOSED_LOOP = ("kinematic", "change")
TASKS = {"reach-v3": 0.7}


def artifact(kind: str) -> Any:
    """A calibration, and nothing else."""
    assert kind == "calibration"
    return SimpleNamespace(k_s=TASKS.__getitem__)


def built(chosen: Any, task: str = "reach-v3") -> Threshold:
    """As a method's part: its numbers are checked, then it is built."""
    part = find("threshold", chosen.kind)
    check_settings(chosen, "threshold")
    found: Threshold = part.built(chosen, Context(SimpleNamespace(actions=SPEC.actions), artifact, task))  # type: ignore[arg-type]
    return found


def threshold(kind: str, **values: Any) -> Threshold:
    given_level = {"k_s": 0.4} if kind in CLOSED_LOOP else {}
    return built(find("threshold", kind).settings(kind=kind, **{**given_level, **values}))


def radius_after(chosen: Threshold, *variability: float | None) -> int:
    for value in variability:
        chosen.update(value)
    return chosen.radius()


def rounded(r: float) -> int:
    return math.floor(r + 0.5)


@settings(deadline=None)  # the machine is shared
@given(levels, st.floats(0.01, 5), st.floats(0.5, 4))
def test_kinematic_is_the_level_form(k, k_s, phi):
    r = radius_after(threshold("kinematic", k_s=k_s, phi=phi), k)
    exact = 5 + 10 * math.exp(-((k / k_s) ** phi))
    assert abs(r - exact) <= 0.5 + 1e-9


def test_kinematic_at_its_landmarks():
    chosen = threshold("kinematic")
    assert chosen.radius() == rounded(5 + 10 / math.e) == 9  # an episode begins at the reference level
    assert radius_after(chosen, 0.0) == 15
    assert radius_after(chosen, 0.4) == 9
    assert radius_after(chosen, 1e300) == 5
    assert radius_after(chosen, None) == 5  # nothing was compared: r stays
    chosen.reset()
    assert chosen.radius() == 9


@settings(deadline=None)  # the machine is shared
@given(st.lists(st.one_of(st.none(), levels, st.floats(0, 1)), max_size=20))
def test_change_is_its_closed_form(history):
    chosen = threshold("change")
    r, last = 5 + 10 * math.exp(-1), 0.4
    assert chosen.radius() == 9
    for k in history:
        if k is not None:
            move = 10 * (1 - math.exp(-((abs(k - last) / 0.4) ** 2)))
            r = min(15.0, max(5.0, r - move if k > last else r + move))
            last = k
        assert abs(radius_after(chosen, k) - r) <= 0.5 + 1e-9
    chosen.reset()
    assert chosen.radius() == 9


def test_schedule_is_the_public_codes_and_open_loop():
    asked = compose("rollout", ["threshold=schedule", "threshold.tau=8"], RolloutSettings).threshold
    chosen, other = built(asked), built(asked)
    for t in range(40):
        assert chosen.radius() == other.radius() == rounded(3 + 12 * math.exp(-((t / 8) ** 3)))
        chosen.update(0.7)
        other.update(None)
    chosen.reset()
    assert chosen.radius() == 15


@pytest.mark.parametrize("kind", CLOSED_LOOP)
def test_the_reference_level_is_the_tasks_where_none_is_given(kind):
    asked = find("threshold", kind).settings(kind=kind)
    assert find("threshold", kind).needs(asked) == ("calibration",)
    assert find("threshold", kind).needs(replace(asked, k_s=0.4)) == ()
    for k in (0.0, 0.3, 2.0):
        assert radius_after(built(asked), k) == radius_after(threshold(kind, k_s=0.7), k)
    assert radius_after(built(asked), 0.5) != radius_after(threshold(kind, k_s=0.3), 0.5)
    with pytest.raises(KeyError, match="push-v3"):
        built(asked, "push-v3")


@pytest.mark.parametrize(
    ("kind", "values", "says"),
    [
        ("fixed", {"r": -1}, r"threshold\.r=-1"),
        ("fixed", {"r": 255}, r"threshold\.r=255: bins from 0 to 254"),
        ("kinematic", {"k_s": 0.0}, r"threshold\.k_s=0\.0"),
        ("kinematic", {"k_s": math.nan}, r"threshold\.k_s=nan"),
        ("kinematic", {"r_min": 16}, r"threshold\.r_min=16 threshold\.r_max=15"),
        ("change", {"r_min": -1}, r"threshold\.r_min=-1"),
        ("schedule", {"r_max": 255}, r"threshold\.r_max=255"),
        ("kinematic", {"phi": 0.0}, r"threshold\.phi=0"),
        ("schedule", {"tau": 0.0}, r"threshold\.tau=0"),
    ],
)
def test_bad_values_get_one_line(kind, values, says):
    with pytest.raises(UsageError, match=says) as caught:
        threshold(kind, **values)
    assert "\n" not in str(caught.value)
