"""Light: the model's lamps and headlight are brighter or darker and shine from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kerv_cli.worlds.stress.base import Model, ModelChanges, Stress, either, level_of
from kerv_cli.worlds.vectors import unit_vector


@dataclass(frozen=True)
class Level:
    """gain: all light is multiplied by it or by its inverse. degrees: by which each lamp's direction is turned about
    a random axis, and the lamp moved around the origin with it."""

    gain: float
    degrees: float


LEVELS = (Level(1.1, 10), Level(1.2, 15), Level(1.3, 20), Level(1.8, 45))


class Light(Stress):
    """It changes the model's lights, not the picture, and nothing of the dynamics."""

    kind = "light"
    changes_model = True

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Scales all light, and turns and moves the lamps."""
        level = level_of(LEVELS, self.level)
        random, head = self.draws.random(), model.vis.headlight
        lights = (model.light_ambient, model.light_diffuse, model.light_specular)
        strengths = (*lights, head.ambient, head.diffuse, head.specular)
        changes.keep(*strengths, model.light_dir, model.light_pos)
        gain = either(random, level.gain)
        for strength in strengths:
            strength[...] *= gain
        for lamp in range(model.nlight):
            turn = Rotation.from_rotvec(unit_vector(random, 3) * np.deg2rad(level.degrees)).as_matrix()
            for vector in (model.light_dir[lamp], model.light_pos[lamp]):
                vector[:] = sum((turn * vector).T)  # in this order on every CPU; `turn @ vector` is OpenBLAS's
