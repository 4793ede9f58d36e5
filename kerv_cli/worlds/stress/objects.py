"""Object: the task's objects are larger or smaller, heavier or lighter, smoother or rougher, and begin outside the
range of the training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kerv_cli.worlds.stress.base import Model, ModelChanges, Stress, either, level_of, objects


@dataclass(frozen=True)
class Level:
    """size, mass, friction: factors that an object's are multiplied or divided by, drawn per episode. spread: factor of
    the range of initial states, around its centre."""

    size: float
    mass: float
    friction: float
    spread: float


LEVELS = (Level(1.1, 1.6, 1.5, 1.2), Level(1.2, 2.5, 2.0, 1.4), Level(1.3, 4.0, 3.0, 1.7), Level(1.5, 6.0, 4.0, 2.3))


class Objects(Stress):
    """Objects are the bodies with joints that no robot moves. Friction is that of all geoms, because a contact has the
    larger one of its two, and the damping of the objects' joints. Meshes and objects on a hinge or a slide keep their
    size."""

    kind = "object"
    changes_model = True

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.spread = level_of(LEVELS, level).spread

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Scales the objects' size, mass and friction."""
        level = level_of(LEVELS, self.level)
        random = self.draws.random()
        size, mass, friction = (either(random, factor) for factor in (level.size, level.mass, level.friction))
        changes.keep(model.geom_friction, model.dof_damping, model.dof_frictionloss, model.dof_invweight0)
        changes.keep(model.body_mass, model.body_inertia, model.body_subtreemass, model.body_invweight0)
        changes.keep(model.body_pos, model.body_ipos, model.bvh_aabb, model.site_pos)
        changes.keep(model.geom_size, model.geom_pos, model.geom_aabb, model.geom_rbound)
        model.geom_friction[:] *= friction
        for body in objects(model):
            dofs = slice(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body])
            model.dof_damping[dofs] *= friction
            model.dof_frictionloss[dofs] *= friction
            grown = size if _is_free_and_primitive(model, body) else 1.0
            for part in np.flatnonzero(model.body_weldid == body):
                _scale(model, int(part), grown, moved=part != body)
                _weigh(model, int(part), mass, grown)
        model.body_subtreemass[:] = model.body_mass
        for body in range(model.nbody - 1, 0, -1):
            model.body_subtreemass[model.body_parentid[body]] += model.body_subtreemass[body]


def _is_free_and_primitive(model: Model, body: int) -> bool:
    import mujoco

    free = model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE
    parts = np.flatnonzero(model.body_weldid == body)
    types = model.geom_type[np.isin(model.geom_bodyid, parts)]
    return bool(free and not np.isin(types, (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)).any())


def _scale(model: Model, body: int, factor: float, moved: bool) -> None:
    """Scales a body's geoms and sites around its origin; a part that is fixed to an object is moved along."""
    if moved:
        model.body_pos[body] *= factor
    model.body_ipos[body] *= factor
    geoms, sites = model.geom_bodyid == body, model.site_bodyid == body
    for values in (model.geom_size, model.geom_pos, model.geom_aabb, model.geom_rbound):
        values[geoms] *= factor
    model.site_pos[sites] *= factor
    model.bvh_aabb[model.body_bvhadr[body] : model.body_bvhadr[body] + model.body_bvhnum[body]] *= factor


def _weigh(model: Model, body: int, mass: float, size: float) -> None:
    """Multiplies a body's mass, and what MuJoCo derived from it when the model was compiled."""
    model.body_mass[body] *= mass
    model.body_inertia[body] *= mass * size**2
    model.body_invweight0[body] /= mass
    dofs = slice(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body])
    model.dof_invweight0[dofs] /= mass
