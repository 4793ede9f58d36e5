"""Colour: background and table have other colours."""

from __future__ import annotations

import numpy as np

from kerv_cli.worlds.stress.base import Model, ModelChanges, Stress, level_of, robot_roots

LEVELS = (0.1, 0.2, 0.3, 0.45)
"""Share of a random colour in the colour that multiplies a surface's texture."""
WIDE = 0.35
"""Metres: a fixed geom whose bounding sphere has this radius or more, or a plane, is background or table."""
_DEFAULT = 0.5, 0.5, 0.5, 1.0  # rgba of a geom whose colour is its material's


class Colour(Stress):
    """The model's floor, walls and table are painted, each body in one colour. The sky is a texture in the graphics
    memory and keeps its colour, and so do the robot and the task's objects."""

    kind = "colour"
    changes_model = True

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Mixes the colours of background and table with random ones."""
        share, random = level_of(LEVELS, self.level), self.draws.random()
        changes.keep(model.geom_rgba)
        scenery = scenery_of(model)
        bodies = sorted({int(model.geom_bodyid[geom]) for geom in scenery})
        colours = {body: random.random(3) for body in bodies}
        for geom in scenery:
            material = model.geom_matid[geom]
            from_material = material >= 0 and np.allclose(model.geom_rgba[geom], _DEFAULT)
            rgba = (model.mat_rgba[material] if from_material else model.geom_rgba[geom]).copy()
            rgba[:3] = (1 - share) * rgba[:3] + share * colours[int(model.geom_bodyid[geom])]
            model.geom_rgba[geom] = rgba


def scenery_of(model: Model) -> list[int]:
    """Ids of the geoms that are background or table."""
    import mujoco

    robots = robot_roots(model)

    def fixed(body: int) -> bool:
        return model.body_weldid[body] == 0 and model.body_mocapid[body] < 0 and model.body_rootid[body] not in robots

    plane = mujoco.mjtGeom.mjGEOM_PLANE
    large = [g for g in range(model.ngeom) if model.geom_type[g] == plane or model.geom_rbound[g] >= WIDE]
    return [g for g in large if fixed(int(model.geom_bodyid[g]))]
