"""The base of every kind of stress: its hooks in an episode, its random numbers and its changes of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from kerv_cli.worlds.settings import MOST_STRESS

if TYPE_CHECKING:
    import mujoco

    from kerv_cli.base.spaces import ActionSpace

Array = NDArray[np.float64]
Model: TypeAlias = "mujoco.MjModel"
L = TypeVar("L")


@dataclass(frozen=True)
class Draws:
    """Random numbers of one episode. They follow from task, seed, kind and level alone, so that every method meets the
    same shift."""

    task: str
    seed: int
    kind: str
    level: int

    def random(self, purpose: str = "", step: int = 0) -> np.random.Generator:
        """A generator of its own for each purpose and control step."""
        return np.random.default_rng([self.seed, step, *f"{self.kind} {self.level} {self.task} {purpose}".encode()])


class ModelChanges:
    """Arrays of a MuJoCo model that a stress changes, with their values before the change."""

    def __init__(self) -> None:
        self._before: list[tuple[NDArray[Any], NDArray[Any]]] = []

    def keep(self, *arrays: NDArray[Any]) -> None:
        """Remembers the values of views into a model, before they are changed."""
        self._before.extend((array, array.copy()) for array in arrays)

    def restore(self) -> None:
        """Puts all values back, the last change first."""
        while self._before:
            array, values = self._before.pop()
            array[...] = values


class Stress:
    """A shift of a stated size, drawn anew for every episode. A kind overrides the hooks that it needs; this class
    shifts nothing.

    kind: its name. level: 1 to MOST_STRESS. spread: factor by which the range of initial states is widened around its
    centre. changes_model: whether `change` does anything.
    """

    kind = "none"
    changes_model = False

    def __init__(self, level: int = 0) -> None:
        self.level = level
        self.spread = 1.0

    def begin(self, task: str, seed: int, space: ActionSpace) -> None:
        """Fixes the episode's random numbers, before its reset. space: of the actions that `act` gets."""
        self.draws = Draws(task, seed, self.kind, self.level)

    def change(self, model: Model, changes: ModelChanges) -> None:
        """Changes the MjModel of an episode that was just reset; `changes.keep` comes before each change."""

    def act(self, action: Array, step: int) -> Array:
        """The action (D,) that is executed instead of the clipped `action`. Called once per control step, in order."""
        return action

    def see(self, camera: str, image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """The image (size, size, 3) that the policy gets instead of `image`, at a control step."""
        return image


NO_STRESS = Stress()


@dataclass
class Spells:
    """Spells of a fixed length that begin at random, at a mean rate, while none lasts.

    steps: control steps of a spell. chance: that one begins, per control step.
    """

    steps: int
    chance: float
    _left: int = field(default=0, init=False)

    @classmethod
    def per_second(cls, rate: float, seconds: float, control_hz: float) -> Spells:
        """rate: spells per second without one."""
        return cls(max(1, round(seconds * control_hz)), min(1.0, rate / control_hz))

    def goes_on(self, random: np.random.Generator) -> tuple[bool, bool]:
        """Whether a spell lasts in this control step, and whether it begins in it."""
        begins = self._left == 0 and bool(random.random() < self.chance)
        if begins:
            self._left = self.steps
        lasts = self._left > 0
        self._left -= lasts
        return lasts, begins


def either(random: np.random.Generator, factor: float) -> float:
    """`factor` or its inverse."""
    return factor if random.random() < 0.5 else 1.0 / factor


def robot_roots(model: Model) -> set[int]:
    """Ids of the root bodies that an actuator moves."""
    import mujoco

    joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    roots = set()
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        body = model.jnt_bodyid[target] if kind in joints else model.site_bodyid[target]
        roots.add(int(model.body_rootid[body]))
    return roots


def objects(model: Model) -> list[int]:
    """Ids of the bodies that move on joints of their own and are no part of a robot."""
    robots = robot_roots(model)
    return [b for b in range(1, model.nbody) if model.body_dofnum[b] > 0 and model.body_rootid[b] not in robots]


def level_of(levels: Sequence[L], level: int) -> L:
    """The numbers of level 1 to MOST_STRESS."""
    assert len(levels) == MOST_STRESS
    return levels[level - 1]
