"""One Meta-World task behind a small interface: paired resets, control steps, frames on demand, scripted experts.

What the simulator does and does not promise is written down from measurements: `env.reset(seed=...)` is ignored there,
so an episode is a task's `rand_vec` (object and goal placement), taken from `MT1(task, seed // 50)`.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import pickle
import warnings
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kerv_cli.environments.camera import Camera, CameraConfig, choose_backend
from kerv_cli.environments.metaworld.tasks import task as find_task
from kerv_cli.errors import KervError, RenderingUnavailable, UsageError

MAX_HORIZON = 500
"""Control steps after which Meta-World refuses to step."""
CONTROL_HZ = 80.0
"""Control steps per second of simulated time."""
STATE_SIZE = 39
ACTION_SIZE = 4
_TASKS_PER_BENCHMARK = 50


@dataclass(frozen=True)
class Observation:
    """What the simulator tells after a reset or a step.

    Attributes:
        state: (39,) float64, privileged: hand xyz [0:3] in metres, gripper opening [3], objects [4:18], the previous
            step's 18 numbers [18:36], goal [36:39]. A policy that must not see objects and goal uses state[:4].
        step: control steps (12.5 ms each) executed since reset.
        success: the task's instantaneous flag at this step; False at reset. It may be lost again.
    """

    state: NDArray[np.float64]
    step: int
    success: bool


def load_simulator() -> None:
    """Imports mujoco with a GL backend where there is one; physics alone works without."""
    try:
        choose_backend()
    except RenderingUnavailable:
        # Without this mujoco asks for glfw, which fails where no display is. frame() raises the reason when called.
        os.environ.setdefault("MUJOCO_GL", "disable")
    import mujoco  # noqa: F401


@functools.lru_cache(maxsize=256)
def _placements(task: str, benchmark_seed: int) -> tuple[Any, ...]:
    """The 50 `metaworld.Task`s of `MT1(task, benchmark_seed)`. Costs 0.4 to 1 s: it resets the task 100 times."""
    load_simulator()
    import metaworld

    with _quiet_simulator():
        return tuple(metaworld.MT1(task, seed=benchmark_seed).train_tasks)


@contextlib.contextmanager
def _quiet_simulator() -> Any:
    # One warning per two expert steps about a range that World clips anyway.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")
        yield


class World:
    """One task's simulator, reused over episodes. Not thread-safe; make one per process, after the process started.

    Attributes:
        task: full name, e.g. `drawer-open-v3`.
        instruction: what the robot is told.
        camera: the view that `frame()` draws.
        horizon: control steps per episode.
        succeeded: whether the success flag was set at any step of this episode.
    """

    def __init__(self, task: str, camera: CameraConfig | None = None, horizon: int = MAX_HORIZON) -> None:
        """Checks the names only; the simulator is built at the first reset.

        Args:
            task: task name, with or without `-v3`.
            camera: what `frame()` shows; the standard view when None.
            horizon: control steps per episode, 1 to 500.

        Raises:
            UnknownName: no such task.
            UsageError: a horizon that Meta-World cannot run.
        """
        if not 1 <= horizon <= MAX_HORIZON:
            raise UsageError(f"horizon must lie between 1 and {MAX_HORIZON} control steps, not {horizon}")
        found = find_task(task)
        self.task = found.name
        self.instruction = found.instruction
        self.camera = camera or CameraConfig()
        self.horizon = horizon
        self.succeeded = False
        self._env: Any = None
        self._cameras: dict[CameraConfig, Camera] = {}
        self._observation: Observation | None = None

    @property
    def observation(self) -> Observation:
        """The latest observation. Raises KervError before the first reset."""
        if self._observation is None:
            raise KervError(f"{self.task}: reset the world before using it")
        return self._observation

    @property
    def done(self) -> bool:
        """Whether the episode succeeded at any step so far, or reached the horizon."""
        return self.succeeded or self.observation.step >= self.horizon

    @property
    def rand_vec(self) -> NDArray[np.float64]:
        """(3,) or (6,) float64: object and goal placement of this episode, all that distinguishes it from others."""
        self.observation  # noqa: B018 - raises before the first reset
        return np.array(self._env._last_rand_vec, dtype=np.float64)

    @property
    def end_effector(self) -> NDArray[np.float64]:
        """(3,) float64: the hand's position in metres, in the simulator's world frame."""
        return self.observation.state[:3].copy()

    def reset(self, seed: int) -> Observation:
        """Starts the episode that `seed` names: the same on every machine with the same simulator versions.

        Args:
            seed: >= 0; task `seed % 50` of `MT1(task, seed=seed // 50)`.

        Raises:
            UsageError: a negative seed.
        """
        if seed < 0:
            raise UsageError(f"episode seed must be 0 or more, not {seed}")
        placement = _placements(self.task, seed // _TASKS_PER_BENCHMARK)[seed % _TASKS_PER_BENCHMARK]
        if self._env is None:
            self._env = pickle.loads(placement.data)["env_cls"]()
        self._env.set_task(placement)
        state, _ = self._env.reset()
        self.succeeded = False
        self._observation = Observation(np.array(state, dtype=np.float64), step=0, success=False)
        return self._observation

    def step(self, action: ArrayLike) -> Observation:
        """Executes one control step of 12.5 ms.

        Args:
            action: (4,) hand displacement per axis (1 is 1 cm) and gripper (+1 closes), clipped to [-1, 1].

        Raises:
            KervError: past the horizon, before the first reset, or an action that is not four finite numbers.
        """
        executed = np.asarray(action, dtype=np.float64)
        if executed.shape != (ACTION_SIZE,) or not np.isfinite(executed).all():
            raise KervError(f"{self.task}: an action is {ACTION_SIZE} finite numbers, not {action!r}")
        step = self.observation.step
        if step >= self.horizon:
            raise KervError(f"{self.task}: the episode ended at step {step}, its horizon; reset before stepping on")
        state, _, _, _, info = self._env.step(np.clip(executed, -1.0, 1.0))
        success = bool(info["success"])
        self.succeeded = self.succeeded or success
        self._observation = Observation(np.array(state, dtype=np.float64), step=step + 1, success=success)
        return self._observation

    def frame(self, camera: CameraConfig | None = None) -> NDArray[np.uint8]:
        """Draws the current state now; nothing is drawn unless asked for.

        Args:
            camera: another view than the world's own; each gets a context that is kept.

        Returns:
            (size, size, 3) uint8 RGB, upright.

        Raises:
            RenderingUnavailable: no OpenGL backend can draw here.
            KervError: before the first reset.
        """
        self.observation  # noqa: B018 - raises before the first reset
        config = camera or self.camera
        if config not in self._cameras:
            self._cameras[config] = Camera(self._env.model, config)
        return self._cameras[config].render(self._drawable_data())

    def _drawable_data(self) -> Any:
        # After a reset the bodies' poses are stale in some tasks (window-close: the window is off by 0.2 m) until the
        # first step. They are recomputed in a copy: the physics must not depend on whether a frame was drawn.
        if self.observation.step > 0:
            return self._env.data
        import mujoco

        data = copy.copy(self._env.data)
        mujoco.mj_forward(self._env.model, data)
        return data

    def close(self) -> None:
        """Frees the graphics contexts and the simulator; a later reset builds them anew."""
        for camera in self._cameras.values():
            camera.close()
        self._cameras.clear()
        if self._env is not None:
            self._env.close()
        self._env, self._observation = None, None

    def __enter__(self) -> World:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Expert:
    """Meta-World's scripted controller of one task: reads the privileged state, keeps none of its own."""

    def __init__(self, task: str) -> None:
        """Raises UnknownName for a task that does not exist."""
        name = find_task(task).name
        load_simulator()
        from metaworld.policies import ENV_POLICY_MAP

        self._policy: Any = ENV_POLICY_MAP[name]()

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        """The expert's action, clipped: (4,) float64 in [-1, 1]. Raw outputs reach 25, so clip before any use."""
        with _quiet_simulator():
            action = self._policy.get_action(observation.state)
        return np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
