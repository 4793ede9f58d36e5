"""Bases of worlds: an environment implements the start, the step and the frame of its simulator."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.base.views import views_of
from kerv_cli.worlds.camera import Camera
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec
from kerv_cli.worlds.stress.base import NO_STRESS, Model, ModelChanges, Stress


class EpisodeWorld(ABC):
    """Implements the protocol `World` except for the simulator. Not thread-safe.

    stress: the shift of its episodes, from the next reset on. stressable: what a stress can change of this world
    (docs/stress.md); one whose `_start` widens the range of initial states by `stress.spread` adds `range`.
    """

    stressable: ClassVar[frozenset[str]] = frozenset({"actions", "images"})

    def __init__(
        self, spec: EnvironmentSpec, task: str, camera: CameraSettings | None = None, horizon: int = 0
    ) -> None:
        """Checks names and numbers only. camera: None for the environment's first. horizon: control steps of
        an episode; 0: the environment's.

        Raises:
            UnknownName: no such task or camera. UsageError: a horizon that the simulator cannot run.
        """
        entry = spec.task(task)
        self.spec, self.task, self.instruction = spec, entry.name, entry.instruction
        self.camera, self.horizon = spec.camera(camera), spec.control_steps(horizon)
        self.steps, self.success, self.succeeded = 0, False, False
        self.stress: Stress = NO_STRESS
        self._observation: Observation | None = None

    @abstractmethod
    def _start(self, seed: int) -> NDArray[np.float64]:
        """Puts the simulator into the episode's initial state; returns the privileged state (s,)."""

    @abstractmethod
    def _advance(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
        """Executes an action (D,) within the limits; returns the privileged state (s,) and the success flag."""

    @abstractmethod
    def _draw(self, camera: CameraSettings) -> NDArray[np.uint8]:
        """(size, size, 3) uint8 RGB, upright, of one camera."""

    @property
    @abstractmethod
    def initial_state(self) -> NDArray[np.float64]:
        """(n,) numbers that, with the task, rebuild the episode's start."""

    @property
    def observation(self) -> Observation:
        """The latest observation, without images. Raises KervError before the first reset."""
        if self._observation is None:
            raise KervError(f"{self.task}: reset the world before using it")
        return self._observation

    @property
    def done(self) -> bool:
        """Whether the episode succeeded at any step so far, or reached the horizon."""
        self.observation  # noqa: B018 - raises before the first reset
        return self.succeeded or self.steps >= self.horizon

    @property
    def end_effector(self) -> NDArray[np.float64]:
        """The first three numbers of the proprioception, (3,) metres."""
        return self.observation.proprioception[:3].copy()

    @property
    def gripper(self) -> float:
        """The number `gripper` of the proprioception; 1 without one."""
        names, values = self.spec.observation.proprioception, self.observation.proprioception
        return float(values[names.index("gripper")]) if "gripper" in names else 1.0

    def reset(self, seed: int) -> Observation:
        """Starts the episode of `seed` and draws its stress. UsageError: a negative seed."""
        if seed < 0:
            raise UsageError(f"episode seed must be 0 or more, not {seed}")
        self.stress.begin(self.task, seed, self.spec.actions)
        state = self._start(seed)
        self.steps, self.success, self.succeeded = 0, False, False
        return self._observe_state(state)

    def step(self, action: ArrayLike) -> Observation:
        """Executes one control step of an action (D,) in environment units, which is clipped to the limits and changed
        by the stress.

        Raises:
            KervError: past the horizon, before the first reset, or an action that is not D finite numbers.
        """
        executed = np.asarray(action, dtype=np.float64)
        space = self.spec.actions
        if executed.shape != (space.dofs,) or not np.isfinite(executed).all():
            raise KervError(f"{self.task}: an action is {space.dofs} finite numbers, not {action!r}")
        self.observation  # noqa: B018 - raises before the first reset
        if self.steps >= self.horizon:
            raise KervError(
                f"{self.task}: the episode ended at step {self.steps}, its horizon; reset before stepping on"
            )
        executed = self.stress.act(np.clip(executed, space.low, space.high), self.steps)
        state, self.success = self._advance(executed)
        self.succeeded = self.succeeded or self.success
        self.steps += 1
        return self._observe_state(state)

    def _observe_state(self, state: NDArray[np.float64]) -> Observation:
        proprioception = state[: len(self.spec.observation.proprioception)]
        self._observation = Observation(proprioception, state, self.instruction)
        return self._observation

    def frame(self, camera: CameraSettings | None = None) -> NDArray[np.uint8]:
        """(size, size x views, 3) uint8 RGB of the current state for a recording, without the stress of images.
        camera: None for the world's own.

        Raises:
            RenderingUnavailable: nothing can be drawn here.
        """
        self.observation  # noqa: B018 - raises before the first reset
        return self._picture(self.camera if camera is None else self.spec.camera(camera), observed=False)

    def observe(self, cameras: Sequence[str]) -> Observation:
        """The latest observation with an image of each of `cameras`, in the size of the world's own camera."""
        self.observation  # noqa: B018 - raises before the first reset
        images = {name: self._picture(self.spec.camera(replace(self.camera, name=name)), True) for name in cameras}
        return self.observation.with_images(images)

    def _picture(self, config: CameraSettings, observed: bool) -> NDArray[np.uint8]:
        """A frame: its views side by side. observed: for a policy, so that a stress changes each camera's image."""
        views = views_of(config.name)
        images = {
            view.name: self._draw(replace(config, name=view.camera, fovy=view.fovy or config.fovy)) for view in views
        }
        if observed:
            images = {camera: self.stress.see(camera, image, self.steps) for camera, image in images.items()}
        parts = [images[view.name] for view in views]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def close(self) -> None:
        """Ends the episode; a subclass also frees its simulator."""
        self._observation = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class MujocoWorld(EpisodeWorld):
    """A world with a MuJoCo model. Each view has a graphics context, opened when it is first drawn. What a stress
    changes of the model is put back at the next reset."""

    stressable = EpisodeWorld.stressable | {"model"}

    def __init__(
        self, spec: EnvironmentSpec, task: str, camera: CameraSettings | None = None, horizon: int = 0
    ) -> None:
        super().__init__(spec, task, camera, horizon)
        self._cameras: dict[CameraSettings, Camera] = {}
        self._changes = ModelChanges()

    @abstractmethod
    def _drawable(self) -> tuple[Model, Any]:
        """The MjModel, and MjData in which all poses are up to date."""

    def reset(self, seed: int) -> Observation:
        """Restores the model, starts the episode of `seed` and applies its stress to the model."""
        self._changes.restore()
        observation = super().reset(seed)
        if self.stress.changes_model:
            self.stress.change(self._drawable()[0], self._changes)
        return observation

    def _draw(self, camera: CameraSettings) -> NDArray[np.uint8]:
        model, data = self._drawable()
        if camera not in self._cameras:
            self._cameras[camera] = Camera(model, camera, camera.name in self.spec.upside_down)
        return self._cameras[camera].render(data)

    def close(self) -> None:
        """Restores the model and frees the graphics contexts."""
        self._changes.restore()
        for camera in self._cameras.values():
            camera.close()
        self._cameras.clear()
        super().close()
