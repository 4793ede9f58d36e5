"""The example with a simulator: seven DoFs, tasks that need rotation, from demonstrations to a recording."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from examples.insertion import SPEC

from kerv_cli.base.errors import KervError
from kerv_cli.base.settings import CameraSettings
from kerv_cli.lab.episode import run_episode
from kerv_cli.lab.expert import ExpertDecoder
from kerv_cli.report.viewing import save_recording
from kerv_cli.report.viewing.viewer import read_recording
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.recording import DemoConfig, record
from kerv_cli.worlds.spec import World

TASKS = tuple(SPEC.tasks)
ROTATION = slice(3, 6)
SMALL = CameraSettings(size=48, supersample=1)


def outcome(world: World, seed: int, turn: bool = True) -> tuple[bool, np.ndarray]:
    """Whether the expert succeeds, with or without its rotations, and the states on the way."""
    expert, observation = SPEC.expert(world.task), world.reset(seed)
    states = [observation.state]
    while not world.done:
        action = expert(observation)
        action[ROTATION] *= turn
        observation = world.step(action)
        states.append(observation.state)
    return world.succeeded, np.array(states)


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_succeeds(task: str) -> None:
    with SPEC.open_world(task) as world:
        assert np.mean([outcome(world, seed)[0] for seed in range(50)]) >= 0.95


@pytest.mark.parametrize("task", TASKS)
def test_nobody_succeeds_who_does_not_turn(task: str) -> None:
    with SPEC.open_world(task) as world:
        for seed in range(8):
            success, states = outcome(world, seed, turn=False)
            assert not success
            assert states[:, 2].min() > 0.03  # the hand was never pushed through anything


@pytest.mark.bits
@pytest.mark.parametrize("task", TASKS)
def test_a_seed_names_one_episode_to_the_last_bit(task: str) -> None:
    with SPEC.open_world(task, SMALL) as world:
        first = outcome(world, 7)[1]
        assert outcome(world, 8)[1][0].tolist() != first[0].tolist()
        start = world.reset(7)
        assert start.state.tobytes() == first[0].tobytes()
        assert world.initial_state.shape == (15,)
        for state in first[1:10]:  # drawing changes nothing
            world.observe(["front", "wrist"])
            start = world.step(SPEC.expert(task)(start))
            assert start.state.tobytes() == state.tobytes()


def test_the_state_says_where_everything_is() -> None:
    with SPEC.open_world("insert-peg") as world:
        state = world.reset(3).state
        assert state.shape == (SPEC.observation.state,)
        assert world.observation.proprioception.tolist() == state[:7].tolist()
        assert state[7:10] == pytest.approx(state[:3] - [0, 0, 0.025])  # the peg hangs in the hand
        assert world.gripper == 0.0
        slot, turned = world.initial_state[:3], world.initial_state[3:6]
        assert (state[10:13], state[13:16]) == (pytest.approx(slot), pytest.approx(turned))
        for _ in range(12):
            world.step([0.01, 0.0, 0.0, 0.0, 0.0, 0.06, 0.0])
        moved = world.observation.state - state
        assert moved[0] == pytest.approx(0.12, abs=0.03)
        assert moved[5] == pytest.approx(0.72, abs=0.15)
        assert np.abs(moved[[1, 2]]).max() < 0.003
        assert moved[7] == pytest.approx(moved[0], abs=0.005)  # and comes along


def test_an_opened_hand_lets_the_peg_fall() -> None:
    with SPEC.open_world("insert-peg") as world:
        before = world.reset(3).state[9]
        for _ in range(10):
            after = world.step([0, 0, 0, 0, 0, 0, 1.0]).state
        assert world.gripper == 1.0
        assert after[9] < before - 0.05
        with pytest.raises(KervError, match="7 finite numbers"):
            world.step(np.zeros(4))


def test_a_control_step_is_cheap() -> None:
    """About 0.1 ms; each draws nothing."""
    with SPEC.open_world("insert-peg") as world:
        world.reset(0)
        began = time.process_time()
        for _ in range(100):
            world.step(np.zeros(7))
        assert (time.process_time() - began) / 100 < 0.001


def test_frames_are_upright_and_show_peg_and_slot() -> None:
    with SPEC.open_world("fetch-peg", CameraSettings(size=96)) as world:
        world.reset(3)
        seen = world.observe(SPEC.cameras).images
        red, green, blue = np.moveaxis(seen["front"].astype(int), 2, 0)
        table = (red > green + 15) & (green > blue + 15)
        assert table[48:].sum() > 2 * table[:48].sum() > 0  # the table is below
        peg = (red > 120) & (green < 90) & (blue < 80)
        slot = (blue > 120) & (red < 90)
        assert 5 < peg.sum() < 400
        assert slot.sum() > 50
        assert np.nonzero(peg)[1].mean() < np.nonzero(slot)[1].mean()  # x grows to the right: not mirrored
        above = seen["top"].astype(int)
        assert ((above[..., 2] > 120) & (above[..., 0] < 110)).sum() > 20


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> DemoDataset:
    out = tmp_path_factory.mktemp("insertion")
    config = DemoConfig(("INSERTION",), episodes=4, camera=SMALL, frame_stride=10, workers=1, tail=5)
    assert (config.camera.name, config.horizon) == ("front", 120)
    record(config, out)
    return DemoDataset.open(out)


def test_demonstrations_carry_their_spaces(demonstrations: DemoDataset) -> None:
    manifest = demonstrations.manifest
    assert (manifest.environment, manifest.actions, manifest.observation) == (
        "insertion",
        SPEC.actions,
        SPEC.observation,
    )
    assert set(manifest.versions) == {"mujoco", "numpy", "python"}
    assert [entry.task for entry in demonstrations.episodes] == [task for task in TASKS for _ in range(4)]
    for index, entry in enumerate(demonstrations.episodes):
        episode = demonstrations.load(index)
        assert episode.states.shape == (entry.steps, 19)
        assert episode.labels.shape == (entry.steps + 5, 7)
        low, high = np.float32(SPEC.actions.low), np.float32(SPEC.actions.high)
        for actions in (episode.labels, episode.executed):
            assert ((actions >= low) & (actions <= high)).all()
        noise = np.abs(episode.executed - episode.labels[: entry.steps])
        assert noise[:, 6].max() == 0.0  # the gripper stays clean
        assert (noise[:, ROTATION].max() > 0.01) == entry.perturbed


def test_an_episode_is_recorded_with_all_seven_names(tmp_path: Path) -> None:
    with SPEC.open_world("fetch-peg") as world:
        episode = run_episode(world, ExpertDecoder(), 100_000)
    assert episode.success
    assert episode.actions.shape == (episode.steps, 7)
    assert (episode.gripper[0], episode.gripper[-1]) == (1.0, 0.0)
    found = read_recording(save_recording(episode, tmp_path / "peg.rrd", method="expert"))
    assert found["episode"]["environment"] == "insertion"
    assert found["timelines"]["time"][1] == episode.steps * 50_000_000  # 20 Hz
