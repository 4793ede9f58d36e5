"""Camera: every camera stands a little elsewhere and looks a little aside, drawn per episode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.stress.base import Draws, ModelChanges, Stress, level_of, unit_vector
from kerv_cli.worlds.stress.turning import turned_quaternion


@dataclass(frozen=True)
class Level:
    """metres: by which a camera is moved in a random direction. degrees: by which it is turned about a random axis."""

    metres: float
    degrees: float


LEVELS = (Level(0.006, 0.6), Level(0.01, 1.0), Level(0.015, 1.5), Level(0.022, 2.2))


class CameraJitter(Stress):
    """All cameras of the model are moved; policies see only theirs."""

    kind = "camera"
    changes_model = True

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Fixes the episode's random numbers."""
        self._draws = Draws(task, seed, self.kind, self.level)

    def change(self, model: Any, changes: ModelChanges) -> None:
        """Moves and turns every camera."""
        level = level_of(LEVELS, self.level)
        random = self._draws.random()
        changes.keep(model.cam_pos, model.cam_quat)
        for camera in range(model.ncam):
            model.cam_pos[camera] += unit_vector(random, 3) * level.metres
            model.cam_quat[camera] = turned_quaternion(random, model.cam_quat[camera], np.deg2rad(level.degrees))
