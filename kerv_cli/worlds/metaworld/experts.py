"""kerv's own scripted experts, for tasks in which demonstrations of Meta-World's expert teach a policy to fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from kerv_cli.worlds.vectors import length

Array = NDArray[np.float64]

GAIN = 15.0
"""Action per metre of distance. Actions saturate at 1, which is reached at a distance of 7 cm."""


class HandlePullSide:
    """Grips the handle, lifts it slowly, and grips again if it slips.

    Meta-World's expert lifts at full speed, so the handle slips through the fingers. Once its hand is more than 3 cm
    above the handle, it goes down with closed fingers and presses the handle back. kerv's expert derives the phase of
    the movement from the gripper's opening. So each action depends only on the current state.
    """

    above = 0.1
    """Height above the handle at which the hand approaches, in metres."""
    far, near = 0.04, 0.02
    """Horizontal distances from the handle in metres. Beyond `far` the hand first rises, beyond `near` it stays up."""
    slipped = 0.05
    """Height of the hand above the handle beyond which the fingers do not hold it, in metres."""
    low = 0.005
    """Height of the hand above the handle at which the fingers close, in metres."""
    shut = 0.66
    """Opening of the gripper below which the fingers hold the handle."""
    lift = 0.4
    """Upward action while lifting. It must be small: the handle's damping resists in proportion to the speed."""

    def get_action(self, state: Array) -> Array:
        """Return the action (4,) for a state (39,), not clipped."""
        hand, opening, handle = state[:3], state[3], state[4:7]
        offset = hand - handle
        aside, height = length(offset[:2]), float(offset[2])
        if aside > self.far or (aside > self.near and height > self.slipped):
            up, gripper = GAIN * (self.above - height), -1.0
        elif opening > self.shut and height > self.low + 0.01:
            up, gripper = GAIN * (self.low - height), -1.0
        elif height > self.slipped:
            up, gripper = 0.0, -1.0
        else:
            up, gripper = 0.0 if opening > self.shut else self.lift, 1.0
        return np.array([*(-GAIN * offset[:2]), up, gripper])


class PegInsertSide:
    """Opens the gripper before going down, carries the peg slowly, and continues if the peg slips a little.

    Meta-World's expert jerks the peg so that it slips. Once the peg hangs more than 2.5 cm below the hand, the expert
    goes down to it with closed fingers and drags it along the table for the rest of the episode.
    """

    above = 0.15
    """Height above the peg at which the hand approaches, in metres."""
    aside = 0.04
    """Horizontal distance from the peg beyond which the hand first moves above it, in metres."""
    held = 0.04
    """The peg counts as being in the fingers if it is at most this far below the hand, in metres."""
    open, shut = 0.6, 0.4
    """Openings of the gripper. Above `open` the hand may go down. Below `shut` the fingers hold the peg."""
    aligned = 0.03
    """Distance from the hole's axis within which the peg may be inserted, in metres."""
    carry = 0.7
    """Largest action while carrying the peg."""
    before, behind, height = 0.05, -0.35, 0.16
    """Goals of the hand in metres: x before the hole, x beyond the hole, and height z."""

    def get_action(self, state: Array) -> Array:
        """Return the action (4,) for a state (39,), not clipped."""
        hand, opening, peg, hole = state[:3], state[3], state[4:7], state[37]
        below = float(hand[2] - peg[2])
        gripper, most = -1.0, 1.0
        if below > self.held and opening > self.open and length((hand - peg)[:2]) <= self.aside:
            to = peg
        elif below > self.held or length((hand - peg)[:2]) > self.aside:
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
"""Name of these experts in recordings and in the identity of `policy=expert`.

It ends with a number. Increase the number if the experts' actions change.
"""

OURS: Mapping[str, Callable[[], HandlePullSide | PegInsertSide]] = {
    "handle-pull-side-v3": HandlePullSide,
    "peg-insert-side-v3": PegInsertSide,
}
"""Task -> class of the expert that replaces Meta-World's."""
