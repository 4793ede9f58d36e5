"""The kind of stress that changes the task's objects."""

from __future__ import annotations

import numpy as np

from kerv_cli.worlds.stress.base import Model, ModelChanges, Stress, factor_or_inverse, robot_roots


class Objects(Stress):
    """Objects have another size, mass and friction, and begin in a wider range.

    Objects are the bodies on joints of their own that no robot moves. Meshes, and objects on a hinge or a slide, keep
    their size. Friction is that of all geoms, because a contact has the larger one of its two, and the damping of the
    objects' joints.

    A level is (size, mass, friction, spread): factors that multiply or divide an object's, drawn per episode; factor of
    the range of initial states around its centre.
    """

    kind = "object"
    changes_model = True
    levels = ((1.1, 1.6, 1.5, 1.2), (1.2, 2.5, 2.0, 1.4), (1.3, 4.0, 3.0, 1.7), (1.5, 6.0, 4.0, 2.3))

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.spread = self.amount[3]

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Scale the objects' size, mass and friction."""
        random = self.generator()
        size, mass, friction = (factor_or_inverse(random, factor) for factor in self.amount[:3])
        changes.keep(model.geom_friction, model.dof_damping, model.dof_frictionloss, model.dof_invweight0)
        changes.keep(model.body_mass, model.body_inertia, model.body_subtreemass, model.body_invweight0)
        changes.keep(model.body_pos, model.body_ipos, model.bvh_aabb, model.site_pos)
        changes.keep(model.geom_size, model.geom_pos, model.geom_aabb, model.geom_rbound)
        model.geom_friction[:] *= friction
        for body in objects(model):
            dofs = slice(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body])
            model.dof_damping[dofs] *= friction
            model.dof_frictionloss[dofs] *= friction
            growth = size if _is_free_and_primitive(model, body) else 1.0
            for part in np.flatnonzero(model.body_weldid == body):
                _scale(model, int(part), growth, moved=part != body)
                _weigh(model, int(part), mass, growth)
        model.body_subtreemass[:] = model.body_mass
        for body in range(model.nbody - 1, 0, -1):
            model.body_subtreemass[model.body_parentid[body]] += model.body_subtreemass[body]


def objects(model: Model) -> list[int]:
    """Return the ids of the bodies on joints of their own that are no part of a robot."""
    robots = robot_roots(model)
    return [b for b in range(1, model.nbody) if model.body_dofnum[b] > 0 and model.body_rootid[b] not in robots]


def _is_free_and_primitive(model: Model, body: int) -> bool:
    import mujoco

    free = model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE
    parts = np.flatnonzero(model.body_weldid == body)
    types = model.geom_type[np.isin(model.geom_bodyid, parts)]
    return bool(free and not np.isin(types, (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)).any())


def _scale(model: Model, body: int, factor: float, moved: bool) -> None:
    """Scale a body's geoms and sites around its origin. A part fixed to an object also moves along."""
    if moved:
        model.body_pos[body] *= factor
    model.body_ipos[body] *= factor
    geoms, sites = model.geom_bodyid == body, model.site_bodyid == body
    for values in (model.geom_size, model.geom_pos, model.geom_aabb, model.geom_rbound):
        values[geoms] *= factor
    model.site_pos[sites] *= factor
    model.bvh_aabb[model.body_bvhadr[body] : model.body_bvhadr[body] + model.body_bvhnum[body]] *= factor


def _weigh(model: Model, body: int, mass: float, size: float) -> None:
    """Multiply a body's mass, and what MuJoCo derived from it when it compiled the model."""
    model.body_mass[body] *= mass
    model.body_inertia[body] *= mass * size**2
    model.body_invweight0[body] /= mass
    dofs = slice(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body])
    model.dof_invweight0[dofs] /= mass
