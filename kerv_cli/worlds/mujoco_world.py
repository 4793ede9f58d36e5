"""Base of worlds that MuJoCo simulates."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.spaces import Observation
from kerv_cli.worlds.camera import Camera
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec, World
from kerv_cli.worlds.stress.base import Model, ModelChanges


class MujocoWorld(World):
    """A world with a MuJoCo model. What a stress changes in the model is restored at the next reset.

    A subclass implements `_drawable` instead of `_draw`.
    """

    stressable = World.stressable | {"model"}

    def __init__(
        self, spec: EnvironmentSpec, task: str, camera: CameraSettings | None = None, horizon: int = 0
    ) -> None:
        super().__init__(spec, task, camera, horizon)
        self._cameras: dict[CameraSettings, Camera] = {}  # each is opened when it is first drawn
        self._changes = ModelChanges()

    @abstractmethod
    def _drawable(self) -> tuple[Model, Any]:
        """Return the MjModel, and MjData in which all poses are up to date."""

    def reset(self, seed: int) -> Observation:
        """Restore the model, start the episode of a seed and apply its stress to the model."""
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
        """Restore the model and free the graphics contexts."""
        self._changes.restore()
        for camera in self._cameras.values():
            camera.close()
        self._cameras.clear()
        super().close()
