"""Poses of the insertion world: a position in metres and a rotation, as quaternion (w, x, y, z)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kerv_cli.worlds.mujoco_world import load_mujoco
from kerv_cli.worlds.vectors import length

load_mujoco()  # chooses the GL backend, which mujoco reads when it is imported
import mujoco  # noqa: E402

Array = NDArray[np.float64]

GRASP = 0.025
"""Metres from the peg's centre up its axis to the grasp, where the hand holds it."""
PEG_HALF = 0.04
"""Half of the peg's length, metres."""


def quaternion_of(vector: Array) -> Array:
    """Rotation vector (3,), radians -> quaternion (w, x, y, z)."""
    angle = length(vector)
    found = np.array([1.0, 0.0, 0.0, 0.0])
    if angle > 0.0:
        mujoco.mju_axisAngle2Quat(found, np.asarray(vector) / angle, angle)
    return found


def vector_of(quaternion: Array) -> Array:
    """Quaternion (w, x, y, z) -> rotation vector (3,), radians, no longer than pi."""
    found = np.zeros(3)
    mujoco.mju_quat2Vel(found, quaternion, 1.0)
    return found


def product(first: Array, second: Array) -> Array:
    """Quaternion (4,) of the rotation `second` followed by `first`."""
    found = np.zeros(4)
    mujoco.mju_mulQuat(found, first, second)
    return found


def inverse(quaternion: Array) -> Array:
    """Quaternion (4,) of the opposite rotation."""
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0])


def rotated(quaternion: Array, vector: Array) -> Array:
    """The vector (3,) rotated by the quaternion."""
    found = np.zeros(3)
    mujoco.mju_rotVecQuat(found, vector, quaternion)
    return found


@dataclass(frozen=True)
class Pose:
    """position (3,) in metres and quaternion (w, x, y, z), in the world's axes."""

    position: Array
    quaternion: Array

    @classmethod
    def of(cls, position: Array, vector: Array) -> Pose:
        """From a position and a rotation vector, radians."""
        return cls(np.asarray(position, dtype=np.float64), quaternion_of(vector))

    @cached_property
    def vector(self) -> Array:
        """The rotation vector, radians."""
        return vector_of(self.quaternion)

    @property
    def angle(self) -> float:
        """Angle of the rotation, radians."""
        return length(self.vector)

    def along(self, distance: float) -> Pose:
        """The pose moved by `distance` metres along its own z axis."""
        return Pose(self.position + rotated(self.quaternion, np.array([0.0, 0.0, distance])), self.quaternion)

    def seen_from(self, other: Pose) -> Pose:
        """This pose in the other's coordinates."""
        back = inverse(other.quaternion)
        return Pose(rotated(back, self.position - other.position), product(back, self.quaternion))

    def within(self, other: Pose) -> Pose:
        """The inverse of `seen_from`: from the other's coordinates to the world's."""
        position = other.position + rotated(other.quaternion, self.position)
        return Pose(position, product(other.quaternion, self.quaternion))


def turn_between(start: Pose, end: Pose) -> Array:
    """Rotation vector (3,) in the world's axes from the rotation of `start` to that of `end`, radians."""
    return vector_of(product(end.quaternion, inverse(start.quaternion)))


def misfit(peg: Pose, slot: Pose) -> tuple[float, float, float]:
    """A peg's pose relative to a slot: depth of its tip below the mouth and distance of its centre from the slot's
    axis, metres; angle between the two, radians."""
    centre = peg.seen_from(slot)
    depth = -float(centre.along(-PEG_HALF).position[2])
    return depth, float(np.hypot(*centre.position[:2])), centre.angle


def limited(vector: Array, most: float) -> Array:
    """The vector, shortened to length `most` if it is longer."""
    own = length(vector)
    return vector if own <= most else vector * (most / own)
