"""Stress: what each kind changes of a world, seeds, levels, refusals, the command line; the same on every CPU."""

import dataclasses
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command import kerv
from examples.insertion import SPEC as INSERTION

from kerv_cli.base.config import compose
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.registry import parts
from kerv_cli.base.settings import read_settings
from kerv_cli.episodes.identity import stress_of
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.runner import Runner, close_worlds
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.worlds import spec_of
from kerv_cli.worlds import stress as stressing
from kerv_cli.worlds.demos.dataset import register_recorded
from kerv_cli.worlds.demos.recording import DemoConfig, record
from kerv_cli.worlds.metaworld.spec import SPEC as METAWORLD
from kerv_cli.worlds.mujoco_world import MujocoWorld
from kerv_cli.worlds.settings import CameraSettings, StressSettings
from kerv_cli.worlds.stress import Sensor

SEED, STEPS, SIZE = 50_006, 24, 48
KINDS = ("push", "sensor", "light")
SEEN = ("sensor", "light")  # kinds that change what the policy sees, and no state


@pytest.fixture(scope="module")
def insertion():
    with INSERTION.open_world("fetch-peg", CameraSettings(size=SIZE)) as world:
        yield world


@pytest.fixture(scope="module")
def metaworld():
    with METAWORLD.open_world("push", CameraSettings(size=SIZE)) as world:
        yield world


def play(world: MujocoWorld, kind: str, level: int, seed: int = SEED, steps: int = STEPS) -> SimpleNamespace:
    """What a policy meets that always executes the same actions: states (steps + 1, s), images as it sees them and as
    they are recorded (n, size, size, 3), and the initial state."""
    world.stress = stressing.build(StressSettings(kind, level))
    space, camera = world.spec.actions, world.spec.cameras[0]
    actions = np.random.default_rng(1).uniform(space.low, space.high, (steps, space.dofs)) * 0.5
    states, images, frames = [world.reset(seed).state], [], []
    for step, action in enumerate(actions):
        if step % 8 == 0:
            images.append(world.observe([camera]).images[camera])
            frames.append(world.frame())
        states.append(world.step(action).state)
    seen = {"states": states, "images": images, "frames": frames, "start": world.initial_state}
    return SimpleNamespace(**{name: np.array(values) for name, values in seen.items()})


def model_of(world: MujocoWorld) -> dict[str, np.ndarray]:
    """All numbers of the model that a stress could change."""
    model: Any = world._drawable()[0]
    names = [name for name in dir(model) if name[0] != "_" and isinstance(getattr(model, name), np.ndarray)]
    head = model.vis.headlight
    own = {name: np.array(getattr(model, name)) for name in names}
    return own | {f"head {name}": np.array(getattr(head, name)) for name in ("ambient", "diffuse", "specular")}


@pytest.mark.bits
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["insertion", "metaworld"])
def test_a_kind_changes_what_it_should_as_the_seed_says_and_level_0_nothing(kind, name, request):
    world = request.getfixturevalue(name)
    plain, other = play(world, "none", 0), play(world, kind, 4, SEED + 1)
    zero, stressed, again = (play(world, kind, level) for level in (0, 4, 4))
    assert stressed.images.tobytes() == again.images.tobytes() != other.images.tobytes()
    assert stressed.states.tobytes() == again.states.tobytes()
    assert plain.states.tobytes() == zero.states.tobytes()
    assert plain.images.tobytes() == zero.images.tobytes()
    assert (plain.states.tobytes() == stressed.states.tobytes()) == (kind in SEEN)
    assert plain.images.tobytes() != stressed.images.tobytes()
    assert (plain.frames.tobytes() == stressed.frames.tobytes()) == (kind == "sensor")
    assert plain.start.tobytes() == stressed.start.tobytes()


@pytest.mark.bits
@pytest.mark.parametrize("name", ["insertion", "metaworld"])
def test_the_model_is_whole_again_at_the_next_episode(name, request):
    world = request.getfixturevalue(name)
    play(world, "none", 0, steps=1)
    before = model_of(world)
    play(world, "light", 4, steps=1)
    during = model_of(world)
    assert any(during[key].tobytes() != before[key].tobytes() for key in before)
    play(world, "none", 0, steps=1)
    after = model_of(world)
    assert [key for key in before if after[key].tobytes() != before[key].tobytes()] == []


@pytest.mark.bits
def test_the_first_image_of_an_episode_shows_the_turned_lamps(insertion):
    """MuJoCo computes a lamp's direction with the bodies' poses, which a world may leave as they were at the start."""
    import mujoco

    insertion.stress = stressing.build(StressSettings("light", 4))
    insertion.reset(SEED)
    first = insertion.frame()
    mujoco.mj_forward(*insertion._drawable())
    assert first.tobytes() == insertion.frame().tobytes()


def test_a_push_drives_the_hand_off_for_a_tenth_of_a_second_in_one_direction():
    stress = stressing.build(StressSettings("push", 4))
    space, still = METAWORLD.actions, np.zeros(4)
    stress.begin("push-v3", SEED, space)
    executed = np.array([stress.act(still, step)[:3] for step in range(400)])
    pushed = np.linalg.norm(executed, axis=1)
    assert set(np.round(pushed, 9)) == {0.0, 1.0}  # 1 cm per step, the most that there is
    first = int(np.argmax(pushed))
    assert (executed[first : first + 8] == executed[first]).all()  # 8 steps at 80 Hz
    assert (executed[first + 8] != executed[first]).any()


@pytest.mark.bits
def test_a_picture_depends_on_the_control_step_and_not_on_how_often_the_policy_looked(insertion):
    camera = INSERTION.cameras[0]

    def seen(looks):
        insertion.stress = stressing.build(StressSettings("sensor", 1))
        insertion.reset(50_005)
        for step in range(9):
            if step in looks:
                insertion.observe([camera])
            insertion.step(np.zeros(7))
        return insertion.observe([camera]).images[camera]

    assert seen(()).tobytes() == seen((0, 3)).tobytes()


def test_a_dropped_picture_is_the_one_observed_before(monkeypatch):
    monkeypatch.setattr(Sensor, "levels", ((1.0, 0.0, 1.0),) * 4)
    stress = stressing.build(StressSettings("sensor", 4))
    stress.begin("push-v3", SEED, METAWORLD.actions)
    first = stress.see("corner4", np.full((4, 4, 3), 100, np.uint8), 0)
    assert stress.see("corner4", np.full((4, 4, 3), 200, np.uint8), 4).tobytes() == first.tobytes()
    assert stress.see("topview", np.full((4, 4, 3), 200, np.uint8), 4).mean() > 190  # another camera's first


@pytest.mark.bits
def test_worlds_are_shared_between_stressed_and_plain_settings():
    stressed = settings("record=0", "world.stress.kind=push", "world.stress.level=4")
    plain = Runner(settings("record=0"), "insert-peg")
    try:
        first, shifted, again = (r.episode(SEED) for r in (plain, Runner(stressed, "insert-peg"), plain))
    finally:
        close_worlds()
    assert first.actions.tobytes() == again.actions.tobytes()
    assert first.path.tobytes() != shifted.path.tobytes()


def settings(*words: str) -> RolloutSettings:
    return compose("rollout", ["policy=expert", "task=insert-peg", *words], RolloutSettings)


def test_a_stress_of_level_0_is_no_stress():
    zero = dataclasses.asdict(settings("world.stress.kind=light"))
    two = dataclasses.asdict(settings("world.stress.kind=light", "world.stress.level=2"))
    assert read_settings(RolloutSettings, two).world.stress == StressSettings("light", 2)
    assert [stress_of(plain)["kind"] for plain in (zero, two)] == ["none", "light"]


def test_what_an_environment_cannot_do_and_unknown_kinds_are_refused(monkeypatch):
    from examples.point_mass import SPEC as POINT
    from examples.point_mass import PointWorld

    renamed = tuple(dataclasses.replace(group, name=f"my {group.name}") for group in INSERTION.actions.groups)
    recorded = register_recorded("tape", INSERTION.actions, INSERTION.observation, {"wipe": "wipe the table"}, "front")
    no_position = dataclasses.replace(INSERTION, actions=dataclasses.replace(INSERTION.actions, groups=renamed))
    for kind, spec, why in (
        ("light", POINT, "have no model"),
        ("push", recorded, "is a recording"),
        ("push", no_position, "have no position"),
    ):
        with pytest.raises(UsageError, match=why):
            spec.check_stress(StressSettings(kind, 1))
    monkeypatch.setattr(PointWorld, "stressable", frozenset({"actions"}))
    with pytest.raises(UsageError, match="not possible in point-mass: its worlds have no images"):
        POINT.check_stress(StressSettings("sensor", 1))
    monkeypatch.undo()
    monkeypatch.setattr(Sensor, "levels", ((1.0, 0.0, 1.0),) * 2)
    with pytest.raises(UsageError, match="level=3: sensor has the levels 0 to 2"):
        POINT.check_stress(StressSettings("sensor", 3))
    monkeypatch.undo()
    for kind in ("push", "sensor"):
        POINT.check_stress(StressSettings(kind, 1))
    for kind in KINDS:
        METAWORLD.check_stress(StressSettings(kind, 4))
        recorded.check_stress(StressSettings(kind, 0))
    check(settings("world.stress.kind=light", "world.stress.level=4"))
    with pytest.raises(UsageError):
        settings("world.stress.level=1")
    with pytest.raises(UnknownName):
        settings("world.stress.kind=pusch")


def test_the_command_line_stresses_and_records_it_in_every_row(tmp_path):
    words = ["rollout", "-m", "policy=expert", "task=insert-peg", "episodes=2", "record=0", f"results={tmp_path}"]
    run = kerv(*words, "world.stress.kind=push", "world.stress.level=0,2", "--json")
    rows = json.loads(run.stdout)["settings"]
    assert [(row["stress"], row["stress_level"]) for row in rows] == [("none", 0), ("push", 2)]


# --- the same on every CPU


SMALL = CameraSettings(size=24, supersample=1)


def recorded_hashes(folder: Path) -> list[str]:
    """Hashes of demonstrations with noise, in two environments."""
    configs = [
        DemoConfig((tasks,), 1, first_seed=1, camera=SMALL, frame_stride=25, workers=1, tail=5)
        for tasks in ("INSERTION", "reach")
    ]
    return [record(config, folder / config.spec.name).sha256 for config in configs]


def stressed() -> list[str]:
    """One hash per kind of stress, at its strongest: an episode's model, states and pictures."""
    spec, found = spec_of("insert-peg"), []
    with spec.open_world("insert-peg", SMALL) as world:
        expert, camera = spec.expert(world.task), world.camera.name
        for kind in sorted(parts("stress")):
            world.stress = stressing.build(StressSettings(kind, 4))
            observation, model = world.reset(50_000), world._drawable()[0]
            seen = [model.light_dir, model.light_pos, model.cam_pos, model.cam_quat, model.geom_rgba]
            for _ in range(12):
                seen += [observation.state, world.observe([camera]).images[camera]]
                observation = world.step(expert(observation))
            found.append(hashlib.sha256(b"".join(array.tobytes() for array in seen)).hexdigest())
    return found


def digests(folder: Path) -> list[str]:
    return recorded_hashes(folder) + stressed()


@pytest.mark.bits
def test_another_kernel_records_and_draws_the_same(tmp_path):
    """OpenBLAS's kernels for Prescott run on every x86-64 and round other bits than those of later CPUs; on other
    machines the variable has no effect. Of Meta-World the float32 state of recordings is compared: in float64 the last
    bit of its gripper's opening is `np.linalg.norm`'s."""
    plugins = {"KERV_PLUGINS": "examples.insertion", "PYTHONPATH": os.pathsep.join(sys.path)}
    environment = os.environ | plugins | {"OPENBLAS_CORETYPE": "Prescott"}
    command = [sys.executable, __file__, str(tmp_path / "other")]
    other = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert other.stdout.split() == digests(tmp_path / "own"), other.stderr


if __name__ == "__main__":
    print(*digests(Path(sys.argv[1])))
