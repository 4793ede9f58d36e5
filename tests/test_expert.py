"""Scripted experts in the policy's place: every reader of their records, our own experts, and a world without one."""

import dataclasses
import math
import warnings
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from examples.point_mass import SPEC as POINT
from rerun_synthetic import read_recording

from kerv_cli.base.config import compose
from kerv_cli.base.errors import KervError, UnknownName, UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.episodes.episode import run_episode
from kerv_cli.episodes.policy import ExpertDecoder, check
from kerv_cli.episodes.rows import decodes_table, episode_row, read_decodes, table_blob
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.report.measures import measure, paired
from kerv_cli.report.viewing import save_recording
from kerv_cli.report.viewing.token_outcomes import summary
from kerv_cli.worlds import EnvironmentPart
from kerv_cli.worlds.demos.recording import DemoConfig, _identity
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.metaworld.world import VERSION, HandlePullSide
from kerv_cli.worlds.settings import EVALUATION_SEED, CameraSettings
from kerv_cli.worlds.spec import World

NAME = "window-close-v3"


@pytest.fixture(scope="module")
def world():
    with SPEC.open_world(NAME) as opened:
        yield opened


@pytest.fixture(scope="module")
def episode(world):
    return run_episode(world, ExpertDecoder(world.task), EVALUATION_SEED)


def test_the_decoder_executes_the_experts_own_actions(world, episode):
    expert, observation, actions = SPEC.expert(NAME), world.reset(EVALUATION_SEED), []
    while not world.done:
        actions.append(expert(observation))
        observation = world.step(np.float32(actions[-1]))
    assert episode.success
    assert episode.steps == len(actions) > 10
    assert (episode.actions == np.float32(actions)).all()
    assert np.abs(episode.actions).max() == 1.0  # raw outputs reach far beyond


def test_rows_keep_it_and_measures_are_undefined_instead_of_divided_by_zero(episode):
    row = episode_row(episode)
    assert (row["forwards"], row["verifications"], row["tokens"], row["first_rejected_count"]) == (0, 0, 0, 0)
    stored = read_decodes(table_blob(decodes_table(episode)))
    assert stored.equals(decodes_table(episode))
    third = stored.to_pylist()[3]
    assert third["actions"] == episode.decodes[3].actions.tolist()
    assert (third["mode"], third["tokens"], third["rounds"]) == ("expert", [], [])
    frame = pd.DataFrame([row | {"task": NAME, "seed": EVALUATION_SEED, "block": "b"}])
    stamps = {"device": "cpu", "device_name": "x", "dtype": "float32", "threads": 1, "run": "r"}
    frame = frame.assign(initial_state=str(row["initial_state"]), **stamps)
    frame["decode_seconds"] = [np.array([decode.seconds for decode in episode.decodes])]
    slow = frame.assign(label="slow", seconds=frame["seconds"] * 10, success=False)
    episodes = pd.concat([frame.assign(label="own"), slow], ignore_index=True)
    found = measure(episodes, paired(episodes, {"own": "slow"}))["own"]
    assert found.success.value == 1.0
    assert (found.counts.only_method, found.counts.both) == (1, 0)
    assert found.time_per_step_ms > 0
    assert found.forwards_per_step == found.skip_rate == 0.0
    assert all(map(math.isnan, (found.AL, found.accepted_per_round, found.AFEP, found.deviation)))


@pytest.mark.parametrize("frames", [False, True])
def test_its_recording_can_be_written_and_read(episode, tmp_path, frames):
    drawn = {i: np.zeros((8, 8, 3), dtype=np.uint8) for i in range(episode.steps + 1)} if frames else {}
    shown = dataclasses.replace(episode, frames=drawn)
    found = read_recording(save_recording(shown, tmp_path / "expert.rrd", method="expert"))
    rows = found["entities"]
    assert rows["/actions"] == rows["/decode/phases"] == rows["/decode/table"] == episode.steps
    assert rows["/mode"] == 1
    assert "/decode/acceptance" not in rows
    assert rows.get("/camera", 0) == len(drawn)
    assert found["blueprint"]
    assert found["episode"]["forwards"] == 0
    assert f"| modes | {episode.steps} expert |" in summary(shown, "expert")


def seen(state: np.ndarray) -> Observation:
    return Observation(state[:4], state)


def test_it_follows_the_task_and_refuses_what_it_cannot_answer():
    state = np.random.default_rng(0).uniform(0, 0.3, 39)
    decoder = ExpertDecoder(NAME)
    assert (decoder.decode(seen(state)).actions != ExpertDecoder("drawer-open-v3").decode(seen(state)).actions).any()
    with pytest.raises(UnknownName, match="window-close"):
        ExpertDecoder("window-clos")


# --- own experts

HANDLE = "handle-pull-side-v3"
PEG = "peg-insert-side-v3"
SEEDS = range(50_000, 50_002)
Acts = Callable[[Observation], np.ndarray]


@pytest.fixture(scope="module")
def handle_world():
    with SPEC.open_world(HANDLE) as opened:
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


def solve(handle_world: World, observation: Observation, expert: Acts) -> tuple[int, float]:
    """Control steps of an expert until the episode ends, and how far it pressed the handle down in them, metres."""
    begin, height, pressed = handle_world.steps, observation.state[6], 0.0
    while not handle_world.done:
        observation = handle_world.step(expert(observation))
        pressed = max(pressed, height - observation.state[6])
    return handle_world.steps - begin, pressed


def slip(handle_world: World, seed: int) -> Observation:
    """The observation behind a slip: the handle half way up, the closed fingers above it."""

    class Hasty(HandlePullSide):
        low, lift = 0.03, 1.0

    hasty, observation = Hasty(), handle_world.reset(seed)
    start = observation.state[6]
    while observation.state[6] < start + 0.01 or observation.state[2] - observation.state[6] < 0.055:
        observation = handle_world.step(np.clip(hasty.get_action(observation.state), -1.0, 1.0))
    assert not handle_world.done
    return observation


def test_the_handle_is_pulled_sooner_than_by_metaworlds_expert(handle_world):
    for seed in SEEDS:
        ours, pressed = solve(handle_world, handle_world.reset(seed), SPEC.expert(HANDLE))
        assert handle_world.success
        assert pressed < 0.01
        assert ours < solve(handle_world, handle_world.reset(seed), metaworlds(HANDLE))[0]


def test_after_a_slip_it_grips_again_instead_of_pressing(handle_world):
    steps, pressed = solve(handle_world, slip(handle_world, SEEDS[0]), SPEC.expert(HANDLE))
    assert handle_world.success
    assert steps < 100
    assert pressed < 0.01
    steps, pressed = solve(handle_world, slip(handle_world, SEEDS[0]), metaworlds(HANDLE))
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
    """In the identity of an expert's episodes, the same for any list of tasks, and in a recording's configuration."""
    lists = (PEG, "reach", f"[{PEG},reach]")  # a worker checks the tasks of a plan one by one
    found = [check(compose("rollout", ["policy=expert", f"task={names}"], RolloutSettings)) for names in lists]
    assert f"{PEG} {VERSION}" in found[0]["expert"]
    assert found[0] == found[1] == found[2]
    configs = [_identity(DemoConfig((task,), episodes=1))["config"] for task in (PEG, "reach-v3")]
    assert [config.get("experts") for config in configs] == [{PEG: VERSION}, None]


# --- example environment


def test_an_episode_runs_and_is_recorded(tmp_path):
    EnvironmentPart(POINT.name)(lambda: POINT)
    with POINT.open_world("push-point") as world:
        record = run_episode(world, ExpertDecoder(world.task), 100_000, CameraSettings(size=24))
        world.reset(100_000)
        assert record.initial_state.tolist() == world.initial_state.tolist()
        with pytest.raises(KervError, match="2 finite numbers"):
            world.step([0.0, 0.0, 0.0])
    assert record.success
    assert (record.environment, record.space) == ("point-mass", POINT.actions)
    assert record.actions.shape == (record.steps, 2)
    assert np.abs(record.actions).max() <= np.float32(0.05)
    assert record.gripper.tolist() == [1.0] * (record.steps + 1)
    assert record.frames[0].shape == (24, 24, 3)
    found = read_recording(save_recording(record, tmp_path / "point.rrd", method="expert"))
    assert found["timelines"]["time"] == (0, record.steps * 100_000_000)


def test_an_environment_may_have_no_experts():
    with pytest.raises(UsageError, match="point-mass has no scripted experts"):
        dataclasses.replace(POINT, expert_class="").expert("push-point")
