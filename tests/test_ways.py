"""Demonstrations in several ways: the detour by hand, recordings on Meta-World, the chain from the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from kerv_cli.app import app
from kerv_cli.environments.camera import CameraConfig
from kerv_cli.environments.demos.dataset import DemoDataset
from kerv_cli.environments.demos.perturbation import Perturbation, is_perturbed
from kerv_cli.environments.demos.recording import DemoConfig, record
from kerv_cli.environments.demos.ways import NEAR, WAYS, Detour, way_of
from kerv_cli.environments.metaworld.spec import SPEC
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.files import read_json
from kerv_cli.spaces import Observation

BOTH = ("left", "right")
CONFIG = DemoConfig(
    tasks=("reach",),
    episodes=6,
    frame_stride=25,
    camera=CameraConfig(size=24, supersample=1),
    workers=1,
    tail=5,
    ways=BOTH,
)


def test_each_way_has_the_same_chance_with_and_without_noise() -> None:
    for noisy in (False, True):
        seeds = [seed for seed in range(800) if is_perturbed(seed, 0.25) == noisy]
        drawn = [way_of("reach-v3", seed, WAYS) for seed in seeds]
        assert drawn == [way_of("reach-v3", seed, WAYS) for seed in seeds]
        assert all(0.24 < drawn.count(way) / len(drawn) < 0.43 for way in WAYS)
    assert [way_of("reach-v3", s, BOTH) for s in range(20)] != [way_of("push-v3", s, BOTH) for s in range(20)]


def seen(hand: tuple[float, ...], goal: tuple[float, ...] = (0.1, 0.9, 0.1)) -> Observation:
    """The object lies behind the hand, the goal to the front and right."""
    state = np.zeros(39)
    state[:3], state[4:7], state[36:39] = hand, (0.0, 0.4, 0.02), goal
    return Observation(state[:4], state, "")


def towards_goal(observation: Observation) -> np.ndarray:
    """An expert that points at the goal, its first DoFs clipped as Meta-World's are."""
    return np.clip([*(10 * (observation.state[36:39] - observation.state[:3])), 1.0], -1, 1)


@pytest.mark.parametrize(
    ("way", "point"),
    [("left", (-0.1, 0.8, 0.2)), ("right", (0.1, 0.8, 0.2)), ("above", (0.0, 0.8, 0.3))],
)
def test_the_way_point_lies_beside_the_middle_of_the_line(way: str, point: tuple[float, ...]) -> None:
    begin, goal = (0.0, 0.6, 0.2), (0.0, 1.0, 0.1)
    detour = Detour(towards_goal, SPEC, way)
    action = detour(seen(begin, goal))
    assert detour.point == pytest.approx(point)
    offset = np.array(point) - begin
    assert action[:3] == pytest.approx(offset / np.abs(offset).max())  # straight there, the fastest DoF at its limit
    assert action[3] == towards_goal(seen(begin, goal))[3]


def test_behind_the_way_point_the_scripted_expert_acts_for_good() -> None:
    goal = (0.0, 1.0, 0.1)
    for passed in ((-0.1 + NEAR / 2, 0.8, 0.2), (0.05, 0.81, 0.2)):  # there, or beside it and as far along
        detour = Detour(towards_goal, SPEC, "left")
        assert detour(seen((0.0, 0.6, 0.2), goal))[0] < 0
        for hand in (passed, (0.0, 0.6, 0.2)):  # also where a push throws the hand back
            assert detour(seen(hand, goal)).tolist() == towards_goal(seen(hand, goal)).tolist()


def test_a_hand_that_cannot_reach_the_way_point_is_left_to_the_scripted_expert() -> None:
    detour = Detour(towards_goal, SPEC, "left")
    held = seen((0.0, 0.6, 0.2), (0.0, 1.0, 0.1))
    actions = np.array([detour(held) for _ in range(SPEC.horizon)])
    turned = np.abs(actions - towards_goal(held)).max(1) > 0
    assert turned[: SPEC.horizon // 4].all()
    assert not turned[SPEC.horizon // 4 :].any()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("ways")
    record(CONFIG, out)
    return out


def test_every_episode_takes_the_way_of_its_seed(recorded: Path) -> None:
    """Left or right of the line from the first position to the goal, half way; noisy ones too."""
    dataset = DemoDataset.open(recorded)
    assert dataset.manifest.config["ways"] == list(BOTH)
    assert {entry.perturbed for entry in dataset.episodes} == {False, True}
    ways = {way_of(entry.task, entry.seed, BOTH) for entry in dataset.episodes}
    assert ways == set(BOTH), "choose seeds that take both"
    for index, entry in enumerate(dataset.episodes):
        episode = dataset.load(index)
        path = episode.end_effector[:, :2] - episode.end_effector[0, :2]
        goal = episode.states[0, 36:38] - episode.end_effector[0, :2]
        length = float(np.linalg.norm(goal))
        middle = path[int(np.argmax(path @ goal / length > 0.45 * length))]
        aside = float(goal[0] * middle[1] - goal[1] * middle[0]) / length  # metres, left is positive
        assert aside > 0.05 if way_of(entry.task, entry.seed, BOTH) == "left" else aside < -0.05, (entry.seed, aside)


@pytest.mark.bits
def test_labels_are_the_clean_expert_at_the_states_that_were_visited(recorded: Path) -> None:
    dataset = DemoDataset.open(recorded)
    index = next(i for i, entry in enumerate(dataset.episodes) if entry.perturbed)
    episode = dataset.load(index)
    noise = (CONFIG.noise_low, CONFIG.noise_high)
    perturb = Perturbation(episode.task, episode.seed, SPEC.actions, noise, CONFIG.burst_probability)
    with SPEC.open_world("reach", CONFIG.camera) as world:
        expert = Detour(SPEC.expert("reach"), SPEC, way_of(episode.task, episode.seed, BOTH))
        observation = world.reset(episode.seed)
        for wanted, executed in zip(episode.labels, episode.executed, strict=False):
            label = expert(observation)
            assert label.astype(np.float32).tobytes() == wanted.tobytes()
            action = perturb(label)
            assert action.astype(np.float32).tobytes() == executed.tobytes()
            observation = world.step(action)


@pytest.mark.bits
def test_a_recording_in_ways_goes_on_and_others_are_what_they_were(recorded: Path, tmp_path: Path) -> None:
    dataset = DemoDataset.open(recorded)
    (recorded / "manifest.json").unlink()
    dataset.episodes[3].path.unlink()
    assert record(CONFIG, recorded) == dataset.manifest
    with pytest.raises(UsageError, match=r"ways=\['left', 'right'\], not \['right'\]: choose another folder"):
        record(replace(CONFIG, ways=("right",)), recorded)
    plain = tmp_path / "plain"
    record(replace(CONFIG, episodes=1, ways=()), plain)
    assert "ways" not in read_json(plain / "recording.json")["config"]  # an older recording, which goes on


@pytest.mark.parametrize(("ways", "message"), [(("lefft",), "did you mean left"), (("left", "left"), "name each once")])
def test_impossible_ways_are_refused(ways: tuple[str, ...], message: str) -> None:
    with pytest.raises((UnknownName, UsageError), match=message):
        replace(CONFIG, ways=ways)


def test_the_chain_runs_from_the_command_line(tmp_path: Path) -> None:
    """Demonstrations, a target, a parallel target, an early drafter, and an episode of each."""

    def kerv(*words: str) -> str:
        result = CliRunner().invoke(app, [*words, f"results={tmp_path}"])
        assert result.exit_code == 0, result.output
        return result.output

    tasks, few = "task=[reach]", ("train.steps=2", "train.batch=8", "train.validate_every=2")
    shape = ("target=nano", "target.observation=state", "demos=two-ways", tasks)
    recording = ("frame_stride=25", "world.camera.size=24", "world.camera.supersample=1", "runtime.workers=1")
    kerv("demos", tasks, "episodes=4", "ways=[left,right]", "name=two-ways", *recording)
    kerv("train", "target", "name=two-ways", *shape, *few)
    kerv("train", "target", "name=two-ways-parallel", "target.parallel=true", *shape, *few)
    kerv("train", "drafter", "drafter=early", "policy.target=two-ways", "demos=two-ways", "drafter.samples=50", *few)
    one = (tasks, "episodes=1", "record=0", "world.horizon=8")
    kerv("rollout", "-m", "method=ar,early_unverified", "policy.target=two-ways", *one)
    kerv("rollout", "method=parallel", "policy.target=two-ways-parallel", *one)
