"""Kinds of stress that change how a MuJoCo model looks, and nothing of its dynamics: light, colour and camera."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from kerv_cli.worlds.stress.base import Model, ModelChanges, Stress, factor_or_inverse, robot_roots
from kerv_cli.worlds.vectors import unit_vector

WIDE = 0.35
"""Metres. A fixed geom is background or table if it is a plane or its bounding sphere has at least this radius."""
_FROM_MATERIAL = 0.5, 0.5, 0.5, 1.0  # rgba of a geom whose colour is its material's


class Light(Stress):
    """All lamps and the headlight are brighter or darker, and lamps shine from elsewhere.

    A level is (gain, degrees): factor of all light, or its inverse; angle by which each lamp is turned about a random
    axis through the origin.
    """

    kind = "light"
    changes_model = True
    levels = ((1.1, 10), (1.2, 15), (1.3, 20), (1.8, 45))

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Scale all light, and turn and move the lamps."""
        gain, degrees = self.amount
        random, head = self.generator(), model.vis.headlight
        lights = (model.light_ambient, model.light_diffuse, model.light_specular)
        strengths = (*lights, head.ambient, head.diffuse, head.specular)
        changes.keep(*strengths, model.light_dir, model.light_pos)
        gain = factor_or_inverse(random, gain)
        for strength in strengths:
            strength[...] *= gain
        for lamp in range(model.nlight):
            turn = _random_turn(random, degrees).as_matrix()
            for vector in (model.light_dir[lamp], model.light_pos[lamp]):
                vector[:] = sum((turn * vector).T)  # in this order on every CPU; `turn @ vector` is OpenBLAS's


class Colour(Stress):
    """Floor, walls and table are painted, each body in one random colour. Sky, robot and objects keep theirs.

    A level is the share of the random colour in the colour that multiplies a surface's texture.
    """

    kind = "colour"
    changes_model = True
    levels = (0.1, 0.2, 0.3, 0.45)

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Mix the colours of background and table with random ones."""
        share, random = self.amount, self.generator()
        changes.keep(model.geom_rgba)
        scenery = scenery_of(model)
        colours = {body: random.random(3) for body in sorted({int(model.geom_bodyid[geom]) for geom in scenery})}
        for geom in scenery:
            material = model.geom_matid[geom]
            from_material = material >= 0 and np.allclose(model.geom_rgba[geom], _FROM_MATERIAL)
            rgba = (model.mat_rgba[material] if from_material else model.geom_rgba[geom]).copy()
            rgba[:3] = (1 - share) * rgba[:3] + share * colours[int(model.geom_bodyid[geom])]
            model.geom_rgba[geom] = rgba


class CameraJitter(Stress):
    """Every camera of the model is a little elsewhere and looks a little aside.

    A level is (metres, degrees): distance in a random direction; angle about a random axis.
    """

    kind = "camera"
    changes_model = True
    levels = ((0.006, 0.6), (0.01, 1.0), (0.015, 1.5), (0.022, 2.2))

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Move and turn every camera."""
        metres, degrees = self.amount
        random = self.generator()
        changes.keep(model.cam_pos, model.cam_quat)
        for camera in range(model.ncam):
            model.cam_pos[camera] += unit_vector(random, 3) * metres
            turn = _random_turn(random, degrees)  # in the camera's own frame
            turned = Rotation.from_quat(model.cam_quat[camera], scalar_first=True) * turn
            model.cam_quat[camera] = turned.as_quat(scalar_first=True)


def _random_turn(random: np.random.Generator, degrees: float) -> Rotation:
    return Rotation.from_rotvec(unit_vector(random, 3) * np.deg2rad(degrees))


def scenery_of(model: Model) -> list[int]:
    """Return the ids of the geoms that are background or table."""
    import mujoco

    robots, plane = robot_roots(model), mujoco.mjtGeom.mjGEOM_PLANE

    def fixed(body: int) -> bool:
        return model.body_weldid[body] == 0 and model.body_mocapid[body] < 0 and model.body_rootid[body] not in robots

    large = [g for g in range(model.ngeom) if model.geom_type[g] == plane or model.geom_rbound[g] >= WIDE]
    return [g for g in large if fixed(int(model.geom_bodyid[g]))]
