"""Scripted experts for LIBERO-Spatial: grip the bowl's rim, lift it, carry it over the plate, lower it.

They have no memory: each action depends only on the current state.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kerv_cli.base.spaces import Observation
from kerv_cli.worlds.spec import EnvironmentSpec

_LEFT, _RIGHT, _ALONG_DRAWER = -90.0, 90.0, 154.0
_SIDES = {
    "bowl-next-to-ramekin": _RIGHT,
    "bowl-next-to-cookie-box": _RIGHT,
    "bowl-on-wooden-cabinet": _RIGHT,
    "bowl-in-top-drawer-of-wooden-cabinet": _ALONG_DRAWER,
}
"""Task -> side of the rim that nothing blocks, as a direction from the bowl's centre, in degrees around the z axis."""
_HIGH = ("bowl-on-wooden-cabinet", "bowl-in-top-drawer-of-wooden-cabinet")

_RIM = 0.05
"""Distance of the grasp from the bowl's centre, in metres."""
_LOW = 0.02
"""Height of the fingertips above the bowl's origin at the grasp, in metres."""
_ABOVE = 0.1
"""Height above the grasp at which the hand arrives, in metres. It is higher while the hand is far away."""
_CARRY = 0.15, 0.28
"""Height of the carried bowl above the plate, in metres: from the table, and from the cabinet."""
_HELD = 0.2
"""Opening of the gripper below which the fingers hold the rim."""
_GAIN, _TURN = 40.0, 6.0
"""Action per metre and per radian of distance."""


class LiberoExpert:
    """Moves a black bowl onto the plate."""

    def __init__(self, spec: EnvironmentSpec, task: str) -> None:
        """Look up at which side the bowl is gripped in a task, and how high it is carried.

        Raises:
            UnknownName: There is no such task.
        """
        name = spec.task(task).name
        angle = math.radians(_SIDES.get(name, _LEFT))
        self._side = np.array([_RIM * math.cos(angle), _RIM * math.sin(angle), _LOW])
        # the fingers of a hand that is not turned open along y; half a turn changes nothing
        yaw = (angle - math.pi / 2 + math.pi / 2) % math.pi - math.pi / 2
        self._turn = Rotation.from_rotvec([0.0, 0.0, yaw])
        self._carry = _CARRY[name in _HIGH]

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        """Return the action (7,), clipped to the limits."""
        state = observation.state
        hand, opening, bowl, plate = state[:3], state[6], state[7:10], state[10:13]
        turn = (self._turn * Rotation.from_rotvec(state[3:6]).inv()).as_rotvec()
        grasp = bowl + self._side
        off = hand - grasp
        aside, height = math.hypot(off[0], off[1]), off[2]
        gripper, to = -1.0, grasp.copy()
        if opening < _HELD and aside < 0.03 and height < 0.04:
            gripper, to = 1.0, hand + plate - bowl
            if math.hypot(*(bowl - plate)[:2]) < 0.025:
                to[2] -= 0.02  # success needs contact
            elif bowl[2] - plate[2] < self._carry - 0.04:
                to = hand + np.array([0.0, 0.0, 0.1])
            else:
                to[2] += self._carry
        elif height < 0.01 and aside < 0.016:
            gripper = 1.0
        elif aside < (0.014 if height > _ABOVE else 0.025) and np.abs(turn).max() < 0.15:
            to[2] -= 0.01
        elif aside > 0.03 and height < _ABOVE - 0.03:
            to = np.array([hand[0], hand[1], grasp[2] + 2 * _ABOVE])
        else:
            to[2] += _ABOVE + min(aside / 2, _ABOVE)
        action = [*(_GAIN * (to - hand)), *(_TURN * turn), gripper]
        return np.clip(action, -1.0, 1.0)
