"""Experts of our own, for tasks whose scripted expert of Meta-World teaches what does not solve them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from kerv_cli.worlds.vectors import length

Array = NDArray[np.float64]

GAIN = 15.0
"""Hand displacement of an action per metre of distance: 1 is reached 7 cm away."""


class HandlePullSide:
    """Grips the handle, lifts it slowly, and grips again after a slip.

    Meta-World's expert lifts at full speed, so that the handle slips through the fingers; once the hand is more than
    3 cm above it, that expert goes down with closed fingers and presses the handle back. Here the gripper's opening
    says which part of the movement it is, so that an action depends on the state alone.
    """

    above = 0.1
    """Metres over the handle at which the hand approaches."""
    aside = 0.04, 0.02
    """Horizontal metres from the handle beyond which the hand rises first; and beyond which it does not go down."""
    slipped = 0.05
    """Metres over the handle at which the fingers hold it no longer."""
    low = 0.005
    """Metres over the handle at which the fingers close."""
    shut = 0.66
    """Gripper opening below which the fingers hold the handle."""
    lift = 0.4
    """Upward action; the handle's damping asks for a force in proportion to the speed."""

    def get_action(self, state: Array) -> Array:
        """The action (4,), not clipped, at a state (39,)."""
        hand, opening, handle = state[:3], state[3], state[4:7]
        offset = hand - handle
        aside, height = length(offset[:2]), float(offset[2])
        far, near = self.aside
        if aside > far or (aside > near and height > self.slipped):
            return self._action(offset, GAIN * (self.above - height), -1.0)
        if opening > self.shut and height > self.low + 0.01:
            return self._action(offset, GAIN * (self.low - height), -1.0)
        if height > self.slipped:
            return self._action(offset, 0.0, -1.0)
        return self._action(offset, 0.0 if opening > self.shut else self.lift, 1.0)

    @staticmethod
    def _action(offset: Array, up: float, gripper: float) -> Array:
        return np.array([*(-GAIN * offset[:2]), up, gripper])


class PegInsertSide:
    """Opens the gripper before it goes down, carries the peg without haste, and carries on where the peg has slipped a
    little in the fingers.

    Meta-World's expert jerks the peg so that it slips; once it hangs more than 2.5 cm below the hand, that expert goes
    down to it with closed fingers, and drags the peg along the table for the rest of the episode.
    """

    above = 0.15
    """Metres over the peg at which the hand approaches."""
    aside = 0.04
    """Horizontal metres from the peg beyond which the hand goes above it."""
    held = 0.04
    """Metres below the hand down to which a peg is in the fingers."""
    open, shut = 0.6, 0.4
    """Gripper openings: above the first the hand may go down, below the second the fingers hold the peg."""
    aligned = 0.03
    """Metres (across the hole's axis) from the axis within which the peg may go in."""
    carry = 0.7
    """Largest action of a hand that carries."""
    before, behind, height = 0.05, -0.35, 0.16
    """Of the hand, metres: x before the hole and behind it, and z."""

    def get_action(self, state: Array) -> Array:
        """The action (4,), not clipped, at a state (39,)."""
        hand, opening, peg, hole = state[:3], state[3], state[4:7], state[37]
        height = float(hand[2] - peg[2])
        gripper, most = -1.0, 1.0
        if length((hand - peg)[:2]) > self.aside:
            to = peg + np.array([0.0, 0.0, self.above])
        elif height > self.held and opening > self.open:
            to = peg
        elif height > self.held:
            to = peg + np.array([0.0, 0.0, self.above])
        elif opening > self.shut:
            to, gripper = peg, 1.0
        else:
            axis = np.array([self.before, hole, self.height])
            inside = length((peg - axis)[1:]) <= self.aligned
            to, gripper, most = axis, 1.0, self.carry
            to[0] = self.behind if inside else self.before
        go = 10.0 * (to - hand)
        return np.array([*(go * min(1.0, most / float(np.abs(go).max()))), gripper])


VERSION = "kerv 1"
"""Names these experts in recordings and in the identity of `policy=expert`; raised when an action of theirs changes."""

OURS: Mapping[str, Callable[[], HandlePullSide | PegInsertSide]] = {
    "handle-pull-side-v3": HandlePullSide,
    "peg-insert-side-v3": PegInsertSide,
}
"""Task -> its expert, in the place of Meta-World's."""
