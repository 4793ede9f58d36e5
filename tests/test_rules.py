"""Boundaries and thresholds against paths whose curvature is known and their closed forms."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import refused
from hypothesis import given
from hypothesis import strategies as st

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.limits import check_settings
from kerv_cli.base.registry import find
from kerv_cli.engine.decisions import Choice
from kerv_cli.engine.parts import Boundary, Threshold
from kerv_cli.engine.record import Round, path_length, variability
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.context import Context
from kerv_cli.methods.heisd.curvature import STILL, BoundaryRanges, radius_of_curvature
from kerv_cli.worlds.metaworld.spec import SPEC

WINDOW = 15
RANGES = BoundaryRanges(radius_low=0.01, radius_high=1.0, length_low=0.0, length_high=0.15)
seeds = st.integers(0, 2**32 - 1)


def boundary_of(kind: str, **values: Any) -> Boundary:
    """As a method's part: its numbers are checked, then it is built; the calibration has `RANGES` for 10 and 15."""
    part = find("boundary", kind)
    chosen = part.settings(kind=kind, **({"f_star": 0.3} if kind == "fused" else {}) | values)
    check_settings(chosen, "boundary")
    calibration = SimpleNamespace(ranges={10: RANGES, WINDOW: RANGES}.__getitem__)

    def artifact(kind):
        assert kind in part.needed(chosen)
        return calibration

    built: Boundary = part.built(chosen, Context(None, artifact))  # type: ignore[arg-type]
    return built


def rotation(rng: np.random.Generator) -> np.ndarray:
    """(3, 3), proper, uniformly random."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def arc(rng: np.random.Generator, radius: float, length: float, n: int = WINDOW) -> np.ndarray:
    """(n, 3) metres: evenly spaced points of an arc in a random plane of the robot's workspace."""
    angles = np.linspace(0, length / radius, n) + rng.uniform(0, 2 * np.pi)
    flat = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n)])
    return flat @ rotation(rng).T + rng.uniform(-1, 1, 3)


def line(rng: np.random.Generator, length: float, n: int = WINDOW) -> np.ndarray:
    direction = rotation(rng)[0]
    return np.linspace(0, length, n)[:, None] * direction + rng.uniform(-1, 1, 3)


@given(seeds, st.floats(0.005, 5.0), st.floats(0.2, 2 * np.pi), st.integers(3, 30))
def test_the_radius_is_exact_on_arcs(seed, radius, angle, n):
    points = arc(np.random.default_rng(seed), radius, radius * angle * (n - 1) / n, n)
    assert radius_of_curvature(points) == pytest.approx(radius, rel=1e-6)


@given(seeds, st.floats(0.01, 0.5), st.integers(3, 30))
def test_a_line_has_no_finite_radius(seed, length, n):
    points = line(np.random.default_rng(seed), length, n)
    assert radius_of_curvature(points) == math.inf
    assert radius_of_curvature(points.astype(np.float32)) > 1e3 * length  # float32 positions bend a line by 0.1 µm


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((2, 3)),
        np.full((WINDOW, 3), 0.6),
        np.repeat([[0.1, 0.6, 0.2], [0.2, 0.5, 0.2]], 5, 0),  # two places only
        np.array([[0, 0, 0], [0.1, 0, 0], [0, 0, 0], [0.1, 0, 0]]),  # to and fro
    ],
)
def test_where_there_is_no_circle_the_radius_is_infinite(points):
    assert radius_of_curvature(points) == math.inf


def test_ranges_are_the_minimum_and_the_95th_percentile_of_finite_values():
    rng = np.random.default_rng(1)
    paths = [np.cumsum(rng.normal(size=(40, 3)) * 0.01, 0) for _ in range(5)]
    paths += [line(rng, 0.2, 60), np.zeros((2, 3))]  # infinite radii, and too short to count
    ranges = BoundaryRanges.fit(paths, WINDOW)
    windows = [p[max(0, e - WINDOW) : e] for p in paths for e in range(3, len(p) + 1)]
    radii = [radius_of_curvature(w) for w in windows]
    finite = [r for r in radii if r < math.inf]
    assert len(finite) < len(radii)
    assert (ranges.radius_low, ranges.radius_high) == (min(finite), pytest.approx(np.percentile(finite, 95)))
    lengths = [path_length(w) for w in windows]
    assert (ranges.length_low, ranges.length_high) == (min(lengths), pytest.approx(np.percentile(lengths, 95)))
    for alpha in (0.5, 0.2):  # the limit F* is a quantile of F over the same windows
        levels = [ranges.fused(r, d, alpha) for r, d in zip(radii, lengths, strict=True)]
        for quantile in (0.1, 0.25, 0.6):
            exact = np.quantile(levels, quantile)
            assert ranges.limit(quantile, alpha) == pytest.approx(exact, abs=0.02 if alpha == 0.5 else 0.08)


def test_demonstrations_without_a_curved_path_have_no_ranges():
    with pytest.raises(CheckpointError):
        BoundaryRanges.fit([line(np.random.default_rng(0), 0.2), np.zeros((9, 3))], WINDOW)
    with pytest.raises(CheckpointError):
        BoundaryRanges(0.1, 0.1, 0.0, 1.0)


def test_normalisation_of_bent_straight_and_still_paths():
    assert RANGES.normalise(0.01, STILL) == (0.0, pytest.approx(STILL / 0.15))
    assert RANGES.normalise(0.505, 0.075) == (pytest.approx(0.5), pytest.approx(0.5))
    assert RANGES.normalise(7.0, 9.0) == RANGES.normalise(math.inf, 0.15) == (1.0, 1.0)
    assert RANGES.normalise(0.0, 0.15) == (0.0, 1.0)
    assert RANGES.normalise(math.inf, 0.0) == (0.0, 0.0)
    assert RANGES.fused(0.505, 0.15, 0.25) == pytest.approx(0.25 * 0.5 + 0.75)
    assert boundary_of("fused").choose(np.full((WINDOW, 3), 0.6)) == Choice("drafter", 0.0)


def test_fused_sends_straight_reaches_to_retrieval_and_bends_to_the_drafter():
    rng = np.random.default_rng(3)
    boundary = boundary_of("fused")
    reach, bend = boundary.choose(line(rng, 0.14)), boundary.choose(arc(rng, 0.02, 0.05))
    assert (reach.mode, bend.mode) == ("retrieval", "drafter")
    assert reach.metric > 0.9 > 0.3 > bend.metric
    with pytest.raises(CheckpointError, match=r"boundary\.quantile.*replace=true"):
        boundary_of("fused", f_star=None)  # a calibration of an earlier version
    exact = boundary_of("fused", f_star=reach.metric)
    assert exact.choose(line(np.random.default_rng(3), 0.14)).mode == "retrieval"  # F ≥ F*


def test_only_the_newest_positions_count():
    rng = np.random.default_rng(4)
    boundary = boundary_of("fused", window=10)
    newest = arc(rng, 0.05, 0.1, 10)
    path = np.concatenate([line(rng, 0.4, 30), newest])
    assert boundary.choose(path) == boundary.choose(newest)
    assert boundary.choose(path) != boundary.choose(path[-15:-5])


@pytest.mark.parametrize("n", [0, 1, 2, 20])
def test_a_fused_boundary_needs_three_positions_and_the_fixed_kinds_need_none(n):
    path = np.arange(3.0 * n).reshape(n, 3)
    assert (boundary_of("fused", f_star=0.0).choose(path) == Choice("drafter", None)) == (n < 3)
    for mode in ("retrieval", "drafter"):
        assert boundary_of(f"always_{mode}").choose(path).mode == mode


# --- thresholds

levels = st.floats(0, 50)
CLOSED_LOOP = ("change", "offset", "quoted")
TASKS = {"reach-v3": 0.7}


def artifact(kind: str) -> Any:
    """A calibration, and nothing else."""
    assert kind == "calibration"
    return SimpleNamespace(k_s=lambda task, measure: TASKS[task])


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


def bump(change: float) -> float:
    """Δr of KERV's formula, with K_S = 0.4, φ = 2 and r within 5 … 15."""
    return 10 * math.exp(-((abs(change) / 0.4) ** 2))


READINGS = {  # r after a decode, from r before it and the change of K; and the first r of an episode
    "change": (lambda r, change: r - math.copysign(10 - bump(change), change), 5 + 10 / math.e),
    "offset": (lambda r, change: 5 + bump(change), 5 + 10 / math.e),
    "quoted": (lambda r, change: r + bump(change), 5.0),
}


@pytest.mark.parametrize("kind", READINGS)
@given(history=st.lists(st.one_of(st.none(), levels, st.floats(0, 1)), max_size=20))
def test_a_reading_of_the_threshold_is_its_closed_form(kind, history):
    chosen = threshold(kind)
    step, first = READINGS[kind]
    r, last = first, 0.4
    assert chosen.radius() == rounded(first)
    for k in history:
        if k is not None:
            r, last = min(15.0, max(5.0, step(r, k - last))), k
        assert abs(radius_after(chosen, k) - r) <= 0.5 + 1e-9
    chosen.reset()
    assert chosen.radius() == rounded(first)


def test_the_offset_tightens_when_the_motion_changes_and_the_literal_formula_never_does():
    offset, literal = threshold("offset"), threshold("quoted")
    for k in (0.1, 0.1, 0.1):
        assert radius_after(literal, k) <= 15 >= radius_after(offset, k)
    assert (offset.radius(), literal.radius()) == (15, 15)
    assert (radius_after(offset, 2.0), radius_after(literal, 2.0)) == (5, 15)


@pytest.mark.parametrize("over", ["compared", "accepted"])
@pytest.mark.parametrize("total", [False, True])
def test_k_counts_the_tokens_that_its_settings_name(over, total):
    rounds = [
        Round("prefill", start=0, target_tokens=(100,), committed=1),
        Round("verify", start=1, drafted=(10, 20, 254, 40), target_tokens=(13, 20, 0, 50), accepted=3, committed=4),
        Round("skip", drafted=(7,) * 4, accepted=4, committed=4),
    ]
    # DoFs: dy, dz, gripper (left out), dx; the last one was rejected
    distances = [3, 0] if over == "accepted" else [3, 0, 10]
    expected = sum(distances) * 2 / 255 / (1 if total else len(distances))
    chosen = built(compose("rollout", ["threshold=offset", f"threshold.over={over}", f"threshold.total={total}"],
                           RolloutSettings).threshold)  # fmt: skip
    assert variability(rounds, SPEC.actions, chosen.measure) == pytest.approx(expected)
    assert variability(rounds[::2], SPEC.actions, chosen.measure) is None


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
    assert find("threshold", kind).needed(asked) == ("calibration",)
    assert find("threshold", kind).needed(replace(asked, k_s=0.4)) == ()
    for k in (0.0, 0.3, 2.0):
        assert radius_after(built(asked), k) == radius_after(threshold(kind, k_s=0.7), k)
    assert radius_after(built(asked), 0.5, 0.6) != radius_after(threshold(kind, k_s=0.05), 0.5, 0.6)
    with pytest.raises(KeyError, match="push-v3"):
        built(asked, "push-v3")


@pytest.mark.parametrize(
    ("kind", "values", "says"),
    [
        ("fixed", {"r": -1}, "threshold.r=-1"),
        ("offset", {"k_s": 0.0}, "threshold.k_s=0.0"),
        ("offset", {"k_s": math.nan}, "threshold.k_s=nan"),
        ("offset", {"r_min": 16}, "threshold.r_min=16 threshold.r_max=15"),
        ("change", {"r_min": -1}, "threshold.r_min=-1"),
        ("offset", {"phi": 0.0}, "threshold.phi=0"),
        ("schedule", {"tau": 0.0}, "threshold.tau=0"),
    ],
)
def test_bad_values_get_one_line(kind, values, says):
    with refused(says, error=UsageError):
        threshold(kind, **values)
