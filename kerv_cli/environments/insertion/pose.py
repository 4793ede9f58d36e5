"""Poses of the insertion world: a position in metres and a rotation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

GRASP = 0.025
"""Metres from the peg's centre up its axis to where the hand holds it."""
PEG_HALF = 0.04
"""Half of the peg's length, metres."""


@dataclass(frozen=True)
class Pose:
    """position (3,), in the world."""

    position: Array
    rotation: Rotation

    @classmethod
    def of(cls, position: Array, vector: Array) -> Pose:
        """From a rotation vector, radians."""
        return cls(np.asarray(position, dtype=np.float64), Rotation.from_rotvec(vector))

    @classmethod
    def from_mujoco(cls, joint: Array) -> Pose:
        """From a free joint's seven numbers: position and quaternion (w, x, y, z)."""
        return cls(joint[:3].copy(), Rotation.from_quat(joint[3:], scalar_first=True))

    def to_mujoco(self) -> Array:
        """(7,) as `from_mujoco`."""
        return np.concatenate([self.position, self.rotation.as_quat(scalar_first=True)])

    @property
    def vector(self) -> Array:
        """The rotation vector, radians."""
        return np.asarray(self.rotation.as_rotvec())

    @property
    def axis(self) -> Array:
        """(3,) where its own z points."""
        return np.asarray(self.rotation.apply([0.0, 0.0, 1.0]))

    def along(self, distance: float) -> Pose:
        """The pose moved along its own axis."""
        return Pose(self.position + distance * self.axis, self.rotation)

    def seen_from(self, other: Pose) -> Pose:
        """This pose in the other's coordinates."""
        inverse = other.rotation.inv()
        return Pose(np.asarray(inverse.apply(self.position - other.position)), inverse * self.rotation)

    def within(self, other: Pose) -> Pose:
        """The inverse of `seen_from`: coordinates in `other` -> the world's."""
        return Pose(other.position + other.rotation.apply(self.position), other.rotation * self.rotation)


def misfit(peg: Pose, slot: Pose) -> tuple[float, float, float]:
    """How a peg lies in a slot: depth of its tip below the mouth and distance of its centre from the slot's axis, in
    metres; angle between the two, radians."""
    tip = peg.along(-PEG_HALF).seen_from(slot)
    centre = peg.seen_from(slot)
    return -float(tip.position[2]), float(np.hypot(*centre.position[:2])), float(tip.rotation.magnitude())


def limited(vector: Array, most: float) -> Array:
    """The vector, no longer than `most`."""
    length = float(np.linalg.norm(vector))
    return vector if length <= most else vector * (most / length)
