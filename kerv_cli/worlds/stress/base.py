"""The base class of every kind of stress, and a class that undoes changes of a MuJoCo model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.registry import Part
from kerv_cli.worlds.settings import StressSettings

if TYPE_CHECKING:
    import mujoco

    from kerv_cli.base.spaces import ActionSpace

Array = NDArray[np.float64]
Model: TypeAlias = "mujoco.MjModel"


@dataclass(frozen=True, kw_only=True)
class StressPart(Part):
    """A kind of stress. The decorated class is a `Stress` (`kerv_cli/worlds/stress/base.py`).

    Args:
        requires: What this kind of stress needs from an environment: entries of `World.stressable`, or `position` for
            an action space with that group.
    """

    kind = "stress"
    requires: tuple[str, ...]


class ModelChanges:
    """Remembers the original values of the arrays of a MuJoCo model that a stress changes."""

    def __init__(self) -> None:
        self._originals: list[tuple[NDArray[Any], NDArray[Any]]] = []

    def keep(self, *arrays: NDArray[Any]) -> None:
        """Remember the current values of some arrays of a model. Call it before changing them."""
        self._originals.extend((array, array.copy()) for array in arrays)

    def restore(self) -> None:
        """Restore the original values of all arrays, the last change first."""
        while self._originals:
            array, values = self._originals.pop()
            array[...] = values


class Stress:
    """A disturbance of known size, drawn anew for every episode. This base class changes nothing.

    A subclass overrides `change`, `act` or `see`. It takes random numbers only from `generator`. So every decoding
    method meets the same disturbance.

    Attributes:
        kind: Name of the kind of stress.
        levels: Size of the disturbance at level 1, 2, ….
        level: Chosen level. 0: no disturbance.
        amount: The entry of `levels` for the chosen level. None at level 0.
        spread: Factor by which the range of initial states is widened around its centre. 1: unchanged.
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
            changes: Call its `keep` with each array before changing the array.
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
    stress: Stress = StressPart.find(settings.kind).built(settings.level)
    return stress


def factor_or_inverse(random: np.random.Generator, factor: float) -> float:
    """Return `factor` or 1 / `factor`, each with probability 1/2."""
    return factor if random.random() < 0.5 else 1.0 / factor


def robot_roots(model: Model) -> set[int]:
    """Return the ids of the robots' root bodies. A root is a robot's if an actuator moves it or a body below it."""
    import mujoco

    joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    roots = set()
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        body = model.jnt_bodyid[target] if kind in joints else model.site_bodyid[target]
        roots.add(int(model.body_rootid[body]))
    return roots
