"""Stress: disturbances of known size, so that the evaluated world differs from the training world (docs/stress.md).

Kinds of stress change the model (light), actions (push) or images (sensor).
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import Part
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds.settings import StressSettings
from kerv_cli.worlds.vectors import unit_vector

if TYPE_CHECKING:
    import mujoco

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
        """Remember the current values of arrays of a model. Call this method before changing them."""
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
    """

    kind: ClassVar[str] = "none"
    levels: ClassVar[tuple[Any, ...]] = ()

    def __init__(self, level: int = 0) -> None:
        if level > len(self.levels):
            raise UsageError(f"world.stress.level={level}: {self.kind} has the levels 0 to {len(self.levels)}")
        self.level = level
        self.amount: Any = self.levels[level - 1] if level else None

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Prepare an episode of a task (full name) before its reset. `act` receives actions of this space."""
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
        """Change the MuJoCo model after a reset. Call `changes.keep` with each array before changing it."""

    def act(self, action: Array, step: int) -> Array:
        """Return the action (D,) to execute in place of the policy's `action` (D,), which is within the limits.

        Called once per control step, in order.
        """
        return action

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        return image


NO_STRESS = Stress()


def build(settings: StressSettings) -> Stress:
    if not settings.active:
        return NO_STRESS
    return StressPart.find(settings.kind).built(settings.level)


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
        from scipy.spatial.transform import Rotation

        gain, degrees = self.amount
        random, head = self.generator(), model.vis.headlight
        lights = (model.light_ambient, model.light_diffuse, model.light_specular)
        strengths = (*lights, head.ambient, head.diffuse, head.specular)
        changes.keep(*strengths, model.light_dir, model.light_pos)
        gain = gain if random.random() < 0.5 else 1.0 / gain
        for strength in strengths:
            strength[...] *= gain
        for lamp in range(model.nlight):
            turn = Rotation.from_rotvec(unit_vector(random, 3) * np.deg2rad(degrees)).as_matrix()
            for vector in (model.light_dir[lamp], model.light_pos[lamp]):
                vector[:] = sum((turn * vector).T)  # not `turn @ vector`: OpenBLAS rounds differently on different CPUs


PUSH_SECONDS = 0.1


@StressPart("push", requires=("actions", "position"))
class Push(Stress):
    """Bursts that push the hand in a random direction at full speed. Rotation and gripper are not changed.

    Each level is the mean number of bursts that begin per second while no burst is running.
    """

    kind = "push"
    levels = (2.0, 4.0, 8.0, 14.0)

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        super().begin(task, seed, space)
        self._random, self._left, self._hz = self.generator(), 0, space.control_hz
        self._position = space.dofs_of("position")
        self._half, self._middle = space.half[self._position], space.middle[self._position]

    def act(self, action: Array, step: int) -> Array:
        if not self._left and self._random.random() < min(1.0, self.amount / self._hz):
            self._left = max(1, round(PUSH_SECONDS * self._hz))
            self._push = self._middle + unit_vector(self._random, len(self._half)) * self._half
        if not self._left:
            return action
        self._left -= 1
        executed = action.copy()
        executed[self._position] = self._push
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
        super().begin(task, seed, space)
        self._last: dict[str, NDArray[np.uint8]] = {}

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
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
