"""Experts of our own on real Meta-World, beside those that they replace."""

import warnings
from collections.abc import Callable

import numpy as np
import pytest

from kerv_cli.base.config import compose
from kerv_cli.base.spaces import Observation
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.worlds.demos.recording import DemoConfig, _identity
from kerv_cli.worlds.metaworld.experts import VERSION, HandlePullSide
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.spec import World

NAME = "handle-pull-side-v3"
PEG = "peg-insert-side-v3"
SEEDS = range(50_000, 50_005)
Acts = Callable[[Observation], np.ndarray]


@pytest.fixture(scope="module")
def world():
    with SPEC.open_world(NAME) as opened:
        yield opened


def metaworlds(name: str) -> Acts:
    """Meta-World's expert of a task."""
    from metaworld.policies import ENV_POLICY_MAP

    policy = ENV_POLICY_MAP[name]()

    def act(observation):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.clip(policy.get_action(observation.state), -1.0, 1.0)

    return act


def solve(world: World, observation: Observation, expert: Acts) -> tuple[int, float]:
    """Control steps of an expert until the episode ends, and how far it pressed the handle down in them, metres."""
    begin, height, pressed = world.steps, observation.state[6], 0.0
    while not world.done:
        observation = world.step(expert(observation))
        pressed = max(pressed, height - observation.state[6])
    return world.steps - begin, pressed


def slip(world: World, seed: int) -> Observation:
    """The observation behind a slip: the handle half way up, the closed fingers above it."""

    class Hasty(HandlePullSide):
        low, lift = 0.03, 1.0

    hasty, observation = Hasty(), world.reset(seed)
    start = observation.state[6]
    while observation.state[6] < start + 0.01 or observation.state[2] - observation.state[6] < 0.055:
        observation = world.step(np.clip(hasty.get_action(observation.state), -1.0, 1.0))
    assert not world.done
    return observation


def test_the_handle_is_pulled_sooner_than_by_metaworlds_expert(world):
    for seed in SEEDS:
        ours, pressed = solve(world, world.reset(seed), SPEC.expert(NAME))
        assert world.success
        assert pressed < 0.01
        assert ours < solve(world, world.reset(seed), metaworlds(NAME))[0]


def test_after_a_slip_it_grips_again_instead_of_pressing(world):
    steps, pressed = solve(world, slip(world, SEEDS[0]), SPEC.expert(NAME))
    assert world.success
    assert steps < 100
    assert pressed < 0.01
    steps, pressed = solve(world, slip(world, SEEDS[0]), metaworlds(NAME))
    assert steps > 200
    assert pressed > 0.04


def test_the_peg_is_carried_without_being_dragged():
    fails = 5  # Meta-World's expert drops the peg there
    with SPEC.open_world(PEG) as opened:
        solve(opened, opened.reset(fails), metaworlds(PEG))
        assert not opened.success
        for seed in (fails, *SEEDS):
            steps, _ = solve(opened, opened.reset(seed), SPEC.expert(PEG))
            assert opened.success
            assert steps < 150


def test_what_ours_did_is_told_from_what_metaworlds_did():
    """In the identity of an expert's cells, and in a recording's configuration; of other tasks nothing changes."""
    peg, reach = (compose("rollout", ["policy=expert", f"task={task}"], RolloutSettings) for task in (PEG, "reach"))
    assert check(peg)["expert"] == f"{PEG} {VERSION}"
    assert "expert" not in check(reach)
    configs = [_identity(DemoConfig((task,), episodes=1))["config"] for task in (PEG, "reach-v3")]
    assert [config.get("experts") for config in configs] == [{PEG: VERSION}, None]
