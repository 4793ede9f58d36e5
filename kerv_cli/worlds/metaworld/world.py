"""Run Meta-World's tasks and scripted experts as kerv's worlds and experts.

Meta-World ignores the seed in `env.reset(seed=...)`. The initial state alone determines an episode: the placement of
object and goal (`rand_vec` in Meta-World). The initial state for kerv's seed s is number s % 50 of Meta-World's
benchmark `MT1(task, s // 50)`.
"""

from __future__ import annotations

import functools
import pickle
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.spaces import Observation
from kerv_cli.worlds.mujoco_world import MujocoWorld, load_mujoco
from kerv_cli.worlds.spec import EnvironmentSpec
from kerv_cli.worlds.vectors import length

_TASKS_PER_BENCHMARK = 50

# Meta-World's experts warn at every second step that an action is out of range. The world clips actions anyway.
warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")


@functools.lru_cache(maxsize=256)
def _placements(task: str, benchmark_seed: int) -> tuple[Any, ...]:
    # initial states of MT1; up to 1 s, because Meta-World resets the task 100 times
    load_mujoco()
    import metaworld

    return tuple(metaworld.MT1(task, seed=benchmark_seed).train_tasks)


class MetaWorld(MujocoWorld):
    """A Meta-World task. Seed s is initial state number `s % 50` of `MT1(task, seed=s // 50)`."""

    _env: Any = None

    @property
    def initial_state(self) -> NDArray[np.float64]:
        """Placement of object and goal in this episode, (3,) or (6,), in metres."""
        self.observation  # noqa: B018 - raises before the first reset
        return np.array(self._env._last_rand_vec, dtype=np.float64)

    @property
    def grip_point(self) -> NDArray[np.float64]:
        """Position (3,) between the fingertips, in metres. The end effector is 4.5 cm above this point."""
        return np.array(self._env.tcp_center, dtype=np.float64)

    def _start(self, seed: int) -> NDArray[np.float64]:
        placement = _placements(self.task, seed // _TASKS_PER_BENCHMARK)[seed % _TASKS_PER_BENCHMARK]
        if self._env is None:
            self._env = pickle.loads(placement.data)["env_cls"]()
        self._env.set_task(placement)
        state, _ = self._env.reset()
        return np.array(state, dtype=np.float64)

    def _advance(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
        state, _, _, _, info = self._env.step(action)
        return np.array(state, dtype=np.float64), bool(info["success"])

    def _drawable(self) -> tuple[Any, Any]:
        return self._env.model, self._env.data

    def close(self) -> None:
        super().close()
        if self._env is not None:
            self._env.close()
        self._env = None


class MetaWorldExpert:
    """Scripted controller of one task: Meta-World's own, or kerv's replacement (`OURS`)."""

    def __init__(self, spec: EnvironmentSpec, task: str) -> None:
        name = spec.task(task).name
        load_mujoco()
        from metaworld.policies import ENV_POLICY_MAP

        self._limits = spec.actions.low, spec.actions.high
        self._policy: Any = {**ENV_POLICY_MAP, **OURS}[name]()

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        # clipped, because the numbers of Meta-World's experts reach 25
        action = self._policy.get_action(observation.state)
        return np.clip(np.asarray(action, dtype=np.float64), *self._limits)


GAIN = 15.0  # action per metre of distance; actions saturate at 1, at a distance of 7 cm


class HandlePullSide:
    """Grips the handle, lifts it slowly, and grips again if it slips.

    Meta-World's expert lifts at full speed, so the handle slips through the fingers. Once the hand is more than 3 cm
    above the handle, that expert goes down with closed fingers and presses the handle back. kerv's expert derives the
    phase of the movement from the gripper's opening. So each action depends only on the current state.
    """

    above = 0.1  # metres above the handle at which the hand approaches
    # horizontal metres from the handle: beyond `far` the hand rises, beyond `near` a raised hand stays up
    far, near = 0.04, 0.02
    slipped = 0.05  # metres above the handle beyond which the fingers do not hold it
    low = 0.005  # metres above the handle at which the fingers close
    shut = 0.66  # opening of the gripper (0 closed, 1 open) below which the fingers hold the handle
    lift = 0.4  # upward action while lifting, small because the handle's damping grows with the speed

    def get_action(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action (4,) for a state (39,), not clipped."""
        hand, opening, handle = state[:3], state[3], state[4:7]
        offset = hand - handle
        aside, height = length(offset[:2]), float(offset[2])
        if aside > self.far or (aside > self.near and height > self.slipped):
            up, gripper = GAIN * (self.above - height), -1.0
        elif opening > self.shut and height > self.low + 0.01:
            up, gripper = GAIN * (self.low - height), -1.0
        elif height > self.slipped:
            up, gripper = 0.0, -1.0
        else:
            up, gripper = 0.0 if opening > self.shut else self.lift, 1.0
        return np.array([*(-GAIN * offset[:2]), up, gripper])


class PegInsertSide:
    """Opens the gripper before going down, carries the peg slowly, and continues if the peg slips a little.

    Meta-World's expert jerks the peg so that it slips. Once the peg hangs more than 2.5 cm below the hand, the expert
    goes down to it with closed fingers and drags it along the table for the rest of the episode.
    """

    above = 0.15  # metres above the peg at which the hand approaches
    aside = 0.04  # horizontal metres from the peg beyond which the hand first moves above it
    held = 0.04  # most metres of the peg below the hand at which the fingers may hold it
    # openings of the gripper (1 is open): above `open` the hand may go down, below `shut` the fingers hold the peg
    open, shut = 0.6, 0.4
    aligned = 0.03  # metres from the hole's axis within which the peg may be inserted
    carry = 0.7  # largest action while carrying the peg
    before, behind, height = 0.05, -0.35, 0.16  # goals of the hand in metres: x before the hole, x beyond it, height z

    def get_action(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        hand, opening, peg, hole = state[:3], state[3], state[4:7], state[37]
        below = float(hand[2] - peg[2])
        gripper, most = -1.0, 1.0
        if below > self.held and opening > self.open and length((hand - peg)[:2]) <= self.aside:
            to = peg
        elif below > self.held or length((hand - peg)[:2]) > self.aside:
            to = peg + np.array([0.0, 0.0, self.above])
        elif opening > self.shut:
            to, gripper = peg, 1.0
        else:
            axis = np.array([self.before, hole, self.height])
            inside = length((peg - axis)[1:]) <= self.aligned
            to, gripper, most = axis, 1.0, self.carry
            to[0] = self.behind if inside else self.before
        go = 10.0 * (to - hand)
        return np.array([*(go * min(1.0, most / float(np.abs(go).max()))), gripper])


# named in recordings and in the identity of `policy=expert`; increase the number if the experts' actions change
VERSION = "kerv 1"

OURS: Mapping[str, Callable[[], HandlePullSide | PegInsertSide]] = {
    "handle-pull-side-v3": HandlePullSide,
    "peg-insert-side-v3": PegInsertSide,
}
