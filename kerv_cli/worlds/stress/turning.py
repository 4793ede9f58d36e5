"""Random rotations of a given angle."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from kerv_cli.worlds.stress.base import Array
from kerv_cli.worlds.vectors import unit_vector


def turned(random: np.random.Generator, angle: float) -> Array:
    """Matrix (3, 3) of a rotation by `angle`, radians, about a random axis."""
    return np.asarray(Rotation.from_rotvec(unit_vector(random, 3) * angle).as_matrix())


def turned_quaternion(random: np.random.Generator, quaternion: Array, angle: float) -> Array:
    """The quaternion (w, x, y, z) rotated by `angle`, radians, about a random axis of its own frame."""
    before = Rotation.from_quat(quaternion, scalar_first=True)
    after = before * Rotation.from_rotvec(unit_vector(random, 3) * angle)
    return np.asarray(after.as_quat(scalar_first=True))
