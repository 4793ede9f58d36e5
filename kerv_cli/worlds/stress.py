"""Stress: disturbances of known size, so that the evaluated world differs from the training world (docs/stress.md).

Kinds of stress change the model (light, colour, camera, objects), actions (push, actuation) or images (sensor).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.registry import Part
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.settings import StressSettings
from kerv_cli.worlds.vectors import unit_vector

if TYPE_CHECKING:
    import mujoco
    from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Model: TypeAlias = "mujoco.MjModel"


@dataclass(frozen=True, kw_only=True)
class StressPart(Part):
    """A kind of stress. It decorates a subclass of `Stress`.

    Args:
        requires: What this kind of stress needs from an environment: entries of `World.stressable`, or `position` if
            the action space must have the group `position`.
    """

    kind = "stress"
    requires: tuple[str, ...]


class ModelChanges(ExitStack):
    """Remembers the original values of arrays of a MuJoCo model. `close` restores them, the last change first."""

    def keep(self, *arrays: NDArray[Any]) -> None:
        """Remember the current values of some arrays of a model. Call this method before changing the arrays."""
        for array in arrays:
            self.callback(np.copyto, array, array.copy())


class Stress:
    """A disturbance of known size, drawn anew for every episode. This base class changes nothing.

    A subclass overrides `change`, `act` or `see`. It takes random numbers only from `generator`. So every decoding
    method meets the same disturbance.

    Attributes:
        kind: Name of the kind of stress.
        levels: Size of the disturbance at level 1, 2, ….
        level: Chosen level. 0 means no disturbance.
        amount: The entry of `levels` for the chosen level. None at level 0.
        spread: Factor by which the range of initial states is widened around its centre. 1 changes nothing.
    """

    kind: ClassVar[str] = "none"
    levels: ClassVar[tuple[Any, ...]] = ()
    spread = 1.0

    def __init__(self, level: int = 0) -> None:
        self.level = level
        self.amount: Any = self.levels[level - 1] if level else None

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Prepare an episode, before its reset.

        Args:
            task: Full name of the task.
            seed: Seed of the episode.
            space: Action space of the actions that `act` receives.
        """
        self._task, self._seed = task, seed

    def generator(self, purpose: str = "", step: int = 0) -> np.random.Generator:
        """Return a random generator that depends only on task, seed, kind, level, and the arguments.

        Args:
            purpose: Distinguishes several generators of an episode, such as one per camera.
            step: Control step.
        """
        text = f"{self.kind} {self.level} {self._task} {purpose}"
        return np.random.default_rng([self._seed, step, *text.encode()])

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Change the MuJoCo model of an episode after its reset.

        Args:
            model: The model.
            changes: Remembers original values. Call `changes.keep` with each array before changing the array.
        """

    def act(self, action: Array, step: int) -> Array:
        """Return the action (D,) to execute. It is called once per control step, in order.

        Args:
            action: (D,) what the policy wants to execute, clipped to the limits.
            step: Control step.
        """
        return action

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """Return the image (size, size, 3) that the policy sees.

        Args:
            camera: Name of the view.
            image: The undisturbed image.
            step: Control step.
        """
        return image


NO_STRESS = Stress()


def build(settings: StressSettings) -> Stress:
    """Return the stress that the settings describe. At level 0 it changes nothing.

    Raises:
        UnknownName: There is no such kind.
    """
    if not settings.active:
        return NO_STRESS
    return StressPart.find(settings.kind).built(settings.level)


def factor_or_inverse(random: np.random.Generator, factor: float) -> float:
    """Return `factor` or 1 / `factor`, each with probability 1/2."""
    return factor if random.random() < 0.5 else 1.0 / factor


def robot_roots(model: Model) -> Iterator[int]:
    """Yield the ids of the robots' root bodies: roots for which an actuator moves the root or a body below it."""
    import mujoco

    joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        body = model.jnt_bodyid[target] if kind in joints else model.site_bodyid[target]
        yield int(model.body_rootid[body])


WIDE = 0.35
"""A fixed geom (shape) is scenery if it is a plane, or if its bounding sphere has at least this radius in metres."""
_FROM_MATERIAL = 0.5, 0.5, 0.5, 1.0  # rgba of a geom that takes its colour from its material


@StressPart("light", requires=("model",))
class Light(Stress):
    """All lights are brighter or darker, and lamps (lights with a position in the scene) shine from other directions.

    Each level is (gain, degrees):

    - gain: factor by which the strength of all lights is multiplied or divided
    - degrees: angle by which each lamp is rotated about a random axis through the origin
    """

    kind = "light"
    levels = ((1.1, 10), (1.2, 15), (1.3, 20), (1.8, 45))

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Scale the strength of all lights. Rotate each lamp's position and direction."""
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
                vector[:] = sum((turn * vector).T)  # not `turn @ vector`: OpenBLAS rounds differently on different CPUs


@StressPart("colour", requires=("model",))
class Colour(Stress):
    """Floor, walls and table get random colours, one per body. Sky, robot and objects keep their colours.

    The new colour is a mixture of the old colour and a random colour. Each level is the share of the random colour. A
    texture is multiplied by the new colour.
    """

    kind = "colour"
    levels = (0.1, 0.2, 0.3, 0.45)

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Mix the colours of floor, walls and table with random colours."""
        share, random = self.amount, self.generator()
        changes.keep(model.geom_rgba)
        scenery = scenery_of(model)
        bodies = np.unique(model.geom_bodyid[scenery]).tolist()
        colours = dict(zip(bodies, random.random((len(bodies), 3)), strict=True))
        for geom in scenery:
            material = model.geom_matid[geom]
            from_material = material >= 0 and np.allclose(model.geom_rgba[geom], _FROM_MATERIAL)
            rgba = (model.mat_rgba[material] if from_material else model.geom_rgba[geom]).copy()
            rgba[:3] = (1 - share) * rgba[:3] + share * colours[int(model.geom_bodyid[geom])]
            model.geom_rgba[geom] = rgba


@StressPart("camera", requires=("model",))
class CameraJitter(Stress):
    """Every camera of the model is slightly moved and turned.

    Each level is (metres, degrees): distance in a random direction, and angle about a random axis.
    """

    kind = "camera"
    levels = ((0.006, 0.6), (0.01, 1.0), (0.015, 1.5), (0.022, 2.2))

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Move and turn every camera."""
        metres, degrees = self.amount
        random = self.generator()
        changes.keep(model.cam_pos, model.cam_quat)
        from scipy.spatial.transform import Rotation

        for camera in range(model.ncam):
            model.cam_pos[camera] += unit_vector(random, 3) * metres
            turn = _random_turn(random, degrees)  # relative to the camera's own axes
            turned = Rotation.from_quat(model.cam_quat[camera], scalar_first=True) * turn
            model.cam_quat[camera] = turned.as_quat(scalar_first=True)


def _random_turn(random: np.random.Generator, degrees: float) -> Rotation:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(unit_vector(random, 3) * np.deg2rad(degrees))


def scenery_of(model: Model) -> list[int]:
    """Return the ids of the geoms (shapes) of the scenery: background and table."""
    import mujoco

    large = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) | (model.geom_rbound >= WIDE)
    fixed = (model.body_weldid == 0) & (model.body_mocapid < 0) & ~np.isin(model.body_rootid, list(robot_roots(model)))
    return np.flatnonzero(large & fixed[model.geom_bodyid]).tolist()


@StressPart("object", requires=("model", "range"))
class Objects(Stress):
    """Objects have another size, mass and friction, and start in a wider range.

    Objects are the bodies with their own joints that do not belong to a robot. The size changes only for objects that
    move freely and have no mesh. The friction of all geoms changes, not only of the objects' geoms, because a
    contact uses the larger friction of the two geoms. The damping of the objects' joints changes, too.

    Each level is (size, mass, friction, spread). The first three are factors. In each episode, one random draw per
    factor decides whether the values of all objects are multiplied by the factor or divided by it. `spread` is the
    factor by which the range of initial states gets wider around its centre.
    """

    kind = "object"
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
            for part in np.flatnonzero(model.body_weldid == body).tolist():
                _scale(model, part, growth, moved=part != body)
                # and what MuJoCo derives from the mass
                model.body_mass[part] *= mass
                model.body_inertia[part] *= mass * growth**2
                model.body_invweight0[part] /= mass
                dofs = slice(model.body_dofadr[part], model.body_dofadr[part] + model.body_dofnum[part])
                model.dof_invweight0[dofs] /= mass
        model.body_subtreemass[:] = model.body_mass
        for body in range(model.nbody - 1, 0, -1):
            model.body_subtreemass[model.body_parentid[body]] += model.body_subtreemass[body]


def objects(model: Model) -> list[int]:
    """Return the ids of the bodies that have their own joints and do not belong to a robot."""
    is_object = (model.body_dofnum > 0) & ~np.isin(model.body_rootid, list(robot_roots(model)))
    return np.flatnonzero(is_object).tolist()


def _is_free_and_primitive(model: Model, body: int) -> bool:
    """Return whether an object moves freely and has no mesh."""
    import mujoco

    free = model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE
    parts = np.flatnonzero(model.body_weldid == body)
    types = model.geom_type[np.isin(model.geom_bodyid, parts)]
    return bool(free and not np.isin(types, (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)).any())


def _scale(model: Model, body: int, factor: float, moved: bool) -> None:
    """Scale the geoms and sites of a body around its origin.

    Args:
        model: The model.
        body: Id of the body.
        factor: Factor of the size.
        moved: Whether to scale the body's position, too. True for a part that is fixed to an object.
    """
    if moved:
        model.body_pos[body] *= factor
    model.body_ipos[body] *= factor
    geoms, sites = model.geom_bodyid == body, model.site_bodyid == body
    for values in (model.geom_size, model.geom_pos, model.geom_aabb, model.geom_rbound):
        values[geoms] *= factor
    model.site_pos[sites] *= factor
    model.bvh_aabb[model.body_bvhadr[body] : model.body_bvhadr[body] + model.body_bvhnum[body]] *= factor


PUSH_SECONDS = 0.1
STUCK_SECONDS = 0.25


def bursts(
    random: np.random.Generator, per_second: float, seconds: float, control_hz: float
) -> Iterator[tuple[bool, bool]]:
    """Yield two booleans for each control step: whether a burst is running, and whether it begins in this step.

    Bursts have a fixed duration and begin at random, one at a time.

    Args:
        random: Random generator. In each control step without a burst, one draw decides whether a burst begins.
        per_second: Mean number of bursts that begin per second while no burst is running.
        seconds: Duration of a burst.
        control_hz: Control steps per second.
    """
    left = 0
    while True:
        begins = left == 0 and bool(random.random() < min(1.0, per_second / control_hz))
        left = max(1, round(seconds * control_hz)) if begins else left
        yield left > 0, begins
        left = max(left - 1, 0)


@StressPart("push", requires=("actions", "position"))
class Push(Stress):
    """Bursts that push the hand in a random direction at full speed. Rotation and gripper are not changed.

    Each level is the mean number of bursts that begin per second while no burst is running.
    """

    kind = "push"
    levels = (2.0, 4.0, 8.0, 14.0)

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Prepare the random numbers of an episode."""
        super().begin(task, seed, space)
        self._random = self.generator()
        self._bursts = bursts(self._random, self.amount, PUSH_SECONDS, space.control_hz)
        self._position = space.dofs_of("position")
        self._half, self._middle = space.half[self._position], space.middle[self._position]
        self._push = self._middle

    def act(self, action: Array, step: int) -> Array:
        """Return the action. During a push, the push replaces the action's position part."""
        runs, begins = next(self._bursts)
        if begins:
            self._push = self._middle + unit_vector(self._random, len(self._half)) * self._half
        if not runs:
            return action
        executed = action.copy()
        executed[self._position] = self._push
        return executed


@StressPart("actuation", requires=("actions",))
class Actuation(Stress):
    """Noise, wrong gains, and bursts in which one DoF is stuck.

    Strict DoFs (those that must equal the target's token, such as a gripper) are not changed. Each level is (noise,
    gain, stuck):

    - noise: standard deviation of Gaussian noise, where 1 is half of a DoF's range
    - gain: largest relative error of a DoF's gain, drawn once per episode
    - stuck: mean number of bursts that begin per second while no burst is running. In a burst one DoF does not move.
    """

    kind = "actuation"
    levels = ((0.3, 0.2, 0.5), (0.6, 0.4, 1.0), (0.9, 0.6, 1.5), (1.8, 0.8, 4.0))

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Draw the gains of the DoFs for an episode."""
        super().begin(task, seed, space)
        self._random = self.generator()
        self._noise, gain, stuck = self.amount
        self._loose = ~space.is_strict
        self._low, self._high = np.array(space.low)[self._loose], np.array(space.high)[self._loose]
        self._half, self._middle = space.half[self._loose], space.middle[self._loose]
        self._gain = 1.0 + self._random.uniform(-gain, gain, len(self._half))
        self._bursts = bursts(self._random, stuck, STUCK_SECONDS, space.control_hz)
        self._stuck = 0

    def act(self, action: Array, step: int) -> Array:
        """Apply gains and noise to the action. A stuck DoF does not move."""
        noise = self._random.normal(0.0, self._noise, len(self._half)) * self._half
        runs, begins = next(self._bursts)
        if begins:
            self._stuck = int(self._random.integers(len(self._half)))
        moved = self._middle + (action[self._loose] - self._middle) * self._gain + noise
        if runs:
            moved[self._stuck] = self._middle[self._stuck]
        executed = action.copy()
        executed[self._loose] = np.clip(moved, self._low, self._high)
        return executed


@StressPart("sensor", requires=("images",))
class Sensor(Stress):
    """Images are noisy and blurred, or repeated. Recorded images and the state are not changed.

    Each level is (noise, blur, dropped):

    - noise: standard deviation for each pixel and colour, in grey levels from 0 to 255
    - blur: standard deviation of the Gaussian, in hundredths of the image's height
    - dropped: probability that the policy sees the previous image again
    """

    kind = "sensor"
    levels = ((16, 0.5, 0.1), (22, 0.65, 0.15), (30, 0.9, 0.2), (97, 3.0, 0.55))

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Prepare an episode: forget the images of the previous episode."""
        super().begin(task, seed, space)
        self._last: dict[str, NDArray[np.uint8]] = {}

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """Return the blurred and noisy image, or this camera's previous image.

        Repeated calls in the same control step use the same random numbers.
        """
        from scipy.ndimage import gaussian_filter

        noise, blur, dropped = self.amount
        random = self.generator(camera, step)
        if random.random() < dropped and camera in self._last:
            return self._last[camera]
        sigma = blur / 100 * image.shape[0]
        blurred = gaussian_filter(image.astype(np.float32), sigma=(sigma, sigma, 0))
        blurred += random.standard_normal(image.shape, dtype=np.float32) * noise
        self._last[camera] = np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
        return self._last[camera]


StressPart("none", requires=()).add()
