"""Camera: every camera stands a little elsewhere and looks a little aside, drawn per episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kerv_cli.worlds.stress.base import Model, ModelChanges, Stress, level_of
from kerv_cli.worlds.vectors import unit_vector


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

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Moves and turns every camera."""
        level = level_of(LEVELS, self.level)
        random = self.draws.random()
        changes.keep(model.cam_pos, model.cam_quat)
        for camera in range(model.ncam):
            model.cam_pos[camera] += unit_vector(random, 3) * level.metres
            turn = Rotation.from_rotvec(unit_vector(random, 3) * np.deg2rad(level.degrees))  # in the camera's own frame
            turned = Rotation.from_quat(model.cam_quat[camera], scalar_first=True) * turn
            model.cam_quat[camera] = turned.as_quat(scalar_first=True)
