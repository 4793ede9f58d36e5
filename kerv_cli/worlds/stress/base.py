"""Base of every kind of stress: its hooks in an episode, its random numbers and its changes of a model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mujoco

    from kerv_cli.base.spaces import ActionSpace

Array = NDArray[np.float64]
Model: TypeAlias = "mujoco.MjModel"


class ModelChanges:
    """Arrays of a MuJoCo model that a stress changes, with their original values."""

    def __init__(self) -> None:
        self._originals: list[tuple[NDArray[Any], NDArray[Any]]] = []

    def keep(self, *arrays: NDArray[Any]) -> None:
        """Remember the values of views into a model. Call it before changing them."""
        self._originals.extend((array, array.copy()) for array in arrays)

    def restore(self) -> None:
        """Write all values back, the last change first."""
        while self._originals:
            array, values = self._originals.pop()
            array[...] = values


class Stress:
    """A shift of a stated size, drawn anew for every episode. This base class shifts nothing.

    A kind overrides the hooks that it needs. It takes random numbers from `generator` alone, so that every method meets
    the same shift.

    Attributes:
        kind: Name.
        levels: Size of the shift at each level, from 1 on.
        changes_model: Whether `change` does anything.
        level: Chosen level. 0 is no shift.
        amount: The entry of `levels` for the chosen level.
        spread: Factor that widens the range of initial states around its centre.
    """

    kind: ClassVar[str] = "none"
    levels: ClassVar[tuple[Any, ...]] = ()
    changes_model: ClassVar[bool] = False
    spread = 1.0

    def __init__(self, level: int = 0) -> None:
        self.level = level
        self.amount: Any = self.levels[level - 1] if level else None

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Fix the episode's random numbers, before its reset.

        Args:
            task: Full name of the task.
            seed: Seed of the episode.
            space: Space of the actions that `act` gets.
        """
        self._task, self._seed = task, seed

    def generator(self, purpose: str = "", step: int = 0) -> np.random.Generator:
        """Return a generator that depends on task, seed, kind and level, and on purpose and control step, alone."""
        text = f"{self.kind} {self.level} {self._task} {purpose}"
        return np.random.default_rng([self._seed, step, *text.encode()])

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Change the MjModel of an episode that was just reset. Call `changes.keep` before each change."""

    def act(self, action: Array, step: int) -> Array:
        """Return the action (D,) to execute instead of the clipped `action`. Called once per control step, in order."""
        return action

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """Return the image (size, size, 3) that the policy sees instead of `image` at a control step."""
        return image


NO_STRESS = Stress()


def factor_or_inverse(random: np.random.Generator, factor: float) -> float:
    """Return `factor` or 1 / `factor`, each with probability one half."""
    return factor if random.random() < 0.5 else 1.0 / factor


def robot_roots(model: Model) -> set[int]:
    """Return the ids of the root bodies that an actuator moves."""
    import mujoco

    joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    roots = set()
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        body = model.jnt_bodyid[target] if kind in joints else model.site_bodyid[target]
        roots.add(int(model.body_rootid[body]))
    return roots
