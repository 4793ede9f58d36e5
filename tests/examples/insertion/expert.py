"""Scripted experts of the insertion tasks: proportional control towards the next pose, without memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.spaces import Observation
from kerv_cli.worlds.spec import EnvironmentSpec
from kerv_cli.worlds.vectors import length

from .pose import GRASP, PEG_HALF, Pose, limited, misfit, turn_between

HOVER = 0.03
"""Metres above the slot's mouth or the grasp at which the hand waits until it is aligned."""
_LOW = 0.004  # metres above the mouth at which a nearly aligned peg waits
_DEPTH = 0.045  # metres below the mouth: where the tip should go
_NEAR, _ALIGNED = 0.003, 0.06  # metres and radians within which the peg is aligned with the slot
_GRASP_NEAR, _GRASP_ALIGNED = 0.009, 0.2  # the same for the hand and the grasp
_HELD_NEAR = 0.015  # metres from the grasp within which closed fingers hold the peg
_GAIN = 0.6  # share of the remaining way per control step


class InsertionExpert:
    """Grasps the peg, moves it over the slot until it is aligned, then along the slot's axis."""

    def __init__(self, spec: EnvironmentSpec, task: str) -> None:
        """Raises UnknownName for a task that does not exist."""
        self.task = spec.task(task).name
        self._low, self._high = np.array(spec.actions.low), np.array(spec.actions.high)

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        """The action (7,) within the limits, from the privileged state (19,)."""
        state = observation.state
        hand, opening = Pose.of(state[:3], state[3:6]), float(state[6])
        peg, slot = Pose.of(state[7:10], state[16:19]), Pose.of(state[10:13], state[13:16])
        grasp = peg.along(GRASP)
        off = hand.seen_from(grasp)
        near = length(off.position)
        if opening < 0.5 and near < _HELD_NEAR:
            return self._towards(hand, hand.seen_from(peg).within(_next_peg(peg, slot)), 0.0)
        if near < _GRASP_NEAR and off.angle < _GRASP_ALIGNED:
            return self._towards(hand, grasp, 0.0)
        beside = float(np.hypot(*off.position[:2]))
        above = beside > _GRASP_NEAR or off.angle > _GRASP_ALIGNED
        return self._towards(hand, grasp.along(HOVER) if above else grasp, 1.0)

    def _towards(self, hand: Pose, wanted: Pose, gripper: float) -> NDArray[np.float64]:
        turn = turn_between(hand, wanted)
        move = limited(_GAIN * (wanted.position - hand.position), float(self._high[0]))
        action = np.concatenate([move, limited(_GAIN * turn, float(self._high[3])), [gripper]])
        return np.clip(action, self._low, self._high)


def _next_peg(peg: Pose, slot: Pose) -> Pose:
    """The next pose of the peg: over the mouth until it is aligned, then in the slot."""
    depth, sideways, askew = misfit(peg, slot)
    off = max(sideways / _NEAR, askew / _ALIGNED)
    if off < (3.0 if depth > 0.002 else 1.0):  # the slot guides a peg that is in it
        return slot.along(PEG_HALF - _DEPTH)
    if depth > -HOVER / 2 and sideways > 5 * _NEAR:  # low and beside the mouth: up first, without turning
        return Pose(peg.position + np.array([0.0, 0.0, HOVER]), peg.quaternion)
    return slot.along(PEG_HALF + (_LOW if off < 4.0 else HOVER))
