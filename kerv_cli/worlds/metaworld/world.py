"""Run Meta-World's tasks and scripted experts as kerv's worlds and experts.

Meta-World ignores the seed in `env.reset(seed=...)`. The initial state alone determines an episode: the placement of
object and goal (`rand_vec` in Meta-World). Meta-World's benchmark `MT1(task, seed // 50)` has the initial states.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import itertools
import pickle
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.spaces import Observation
from kerv_cli.worlds.metaworld.experts import OURS
from kerv_cli.worlds.mujoco_world import MujocoWorld, load_mujoco
from kerv_cli.worlds.spec import EnvironmentSpec

_TASKS_PER_BENCHMARK = 50


@functools.lru_cache(maxsize=256)
def _placements(task: str, benchmark_seed: int) -> tuple[Any, ...]:
    """Return the 50 initial states (`metaworld.Task`) of `MT1(task, benchmark_seed)`.

    It takes up to 1 s because Meta-World resets the task 100 times.
    """
    load_mujoco()
    import metaworld

    with _quiet_simulator():
        return tuple(metaworld.MT1(task, seed=benchmark_seed).train_tasks)


@contextlib.contextmanager
def _quiet_simulator() -> Iterator[None]:
    # The experts warn at every second step that an action is out of range. The world clips actions anyway.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")
        yield


class MetaWorld(MujocoWorld):
    """A Meta-World task. Seed s is initial state number `s % 50` of `MT1(task, seed=s // 50)`."""

    stressable = MujocoWorld.stressable | {"range"}

    _env: Any = None

    @property
    def initial_state(self) -> NDArray[np.float64]:
        """Placement of object and goal in this episode, (3,) or (6,) float64, in metres."""
        self.observation  # noqa: B018 - raises before the first reset
        return np.array(self._env._last_rand_vec, dtype=np.float64)

    @property
    def grip_point(self) -> NDArray[np.float64]:
        """Position (3,) between the fingertips, in metres. The end effector is 4.5 cm above it."""
        return np.array(self._env.tcp_center, dtype=np.float64)

    def _start(self, seed: int) -> NDArray[np.float64]:
        placement = _placements(self.task, seed // _TASKS_PER_BENCHMARK)[seed % _TASKS_PER_BENCHMARK]
        if self._env is None:
            self._env = pickle.loads(placement.data)["env_cls"]()
        self._env.set_task(placement)
        with contextlib.nullcontext() if self.stress.spread == 1.0 else self._wider_placement():
            state, _ = self._env.reset()
        return np.array(state, dtype=np.float64)

    @contextlib.contextmanager
    def _wider_placement(self) -> Iterator[None]:
        """Make resets move object and goal away from the centre of their range, by the factor `stress.spread`.

        They move horizontally. The task can refuse a placement, for example an object too close to its goal. Then the
        distance is halved until the task accepts.
        """
        env = self._env
        inside, space = env._last_rand_vec, env._random_reset_space
        outwards = (self.stress.spread - 1.0) * (inside - (space.low + space.high) / 2)
        outwards[2::3] = 0.0  # heights
        reset_model = env.reset_model

        def reset_outside() -> Any:  # a reset calls this twice; it asks for placements until it accepts one
            shares = (0.5**tries for tries in itertools.count())

            def placement() -> NDArray[np.float64]:
                env._last_rand_vec = inside + outwards * next(shares)
                return np.array(env._last_rand_vec)

            env._get_state_rand_vec = placement
            return reset_model()

        env.reset_model = reset_outside
        try:
            yield
        finally:
            del env.reset_model, env._get_state_rand_vec

    def _advance(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
        state, _, _, _, info = self._env.step(action)
        return np.array(state, dtype=np.float64), bool(info["success"])

    def _drawable(self) -> tuple[Any, Any]:
        # After a reset the bodies' poses are stale in some tasks (window-close: the window is off by 0.2 m) until the
        # first step. They are recomputed in a copy, because the physics must not depend on whether a frame is drawn.
        model, data = self._env.model, self._env.data
        if self.steps == 0:
            import mujoco

            data = copy.copy(data)
            mujoco.mj_forward(model, data)
        return model, data

    def close(self) -> None:
        """Free simulator and graphics. A later reset builds them again."""
        super().close()
        if self._env is not None:
            self._env.close()
        self._env = None


class MetaWorldExpert:
    """Scripted controller of one task: Meta-World's own, or kerv's replacement (`experts.OURS`)."""

    def __init__(self, spec: EnvironmentSpec, task: str) -> None:
        """Find the controller of a task.

        Raises:
            UnknownName: There is no such task.
        """
        name = spec.task(task).name
        load_mujoco()
        from metaworld.policies import ENV_POLICY_MAP

        self._limits = spec.actions.low, spec.actions.high
        self._policy: Any = {**ENV_POLICY_MAP, **OURS}[name]()

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        """Return the expert's action (4,), clipped to the limits. Without clipping, its numbers reach 25."""
        with _quiet_simulator():
            action = self._policy.get_action(observation.state)
        return np.clip(np.asarray(action, dtype=np.float64), *self._limits)
