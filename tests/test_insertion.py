"""The example with a simulator: seven DoFs, tasks that need rotation, from demonstrations to a recording."""

import numpy as np
import pytest
from examples.insertion import SPEC

from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.recording import DemoConfig, record
from kerv_cli.worlds.settings import CameraSettings
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
def test_the_expert_succeeds_and_nobody_who_does_not_turn(task):
    with SPEC.open_world(task) as world:
        assert np.mean([outcome(world, seed)[0] for seed in range(50)]) >= 0.95
        for seed in range(8):
            success, states = outcome(world, seed, turn=False)
            assert not success
            assert states[:, 2].min() > 0.03  # the hand was never pushed through anything


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    out = tmp_path_factory.mktemp("insertion")
    config = DemoConfig(("INSERTION",), episodes=4, camera=SMALL, frame_stride=10, workers=1, tail=5)
    assert (config.camera.name, config.horizon) == ("front", 120)
    record(config, out)
    return DemoDataset.open(out)


def test_demonstrations_carry_their_spaces(demonstrations):
    manifest = demonstrations.manifest
    assert (manifest.actions, manifest.observation) == (SPEC.actions, SPEC.observation)
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
