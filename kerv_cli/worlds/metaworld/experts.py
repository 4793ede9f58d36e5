"""kerv's own experts, for tasks whose scripted expert in Meta-World teaches what does not solve them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from kerv_cli.worlds.vectors import length

Array = NDArray[np.float64]

GAIN = 15.0
"""Hand displacement of an action per metre of distance. Actions saturate at 1, 7 cm away."""


class HandlePullSide:
    """Grips the handle, lifts it slowly, and grips again after a slip.

    Meta-World's expert lifts at full speed, so that the handle slips through the fingers. Once the hand is more than
    3 cm above it, that expert goes down with closed fingers and presses the handle back. This one reads the phase of
    the movement from the gripper's opening, so that an action depends on the state alone.
    """

    above = 0.1
    """Metres above the handle at which the hand approaches."""
    far, near = 0.04, 0.02
    """Horizontal metres from the handle. Beyond `far` the hand rises first, beyond `near` it does not go down."""
    slipped = 0.05
    """Metres above the handle from which on the fingers no longer hold it."""
    low = 0.005
    """Metres above the handle at which the fingers close."""
    shut = 0.66
    """Gripper opening below which the fingers hold the handle."""
    lift = 0.4
    """Upward action. The handle's damping needs a force in proportion to the speed."""

    def get_action(self, state: Array) -> Array:
        """Return the action (4,) at a state (39,), not clipped."""
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
    """Opens the gripper before it goes down, carries the peg slowly, and goes on if the peg has slipped a little.

    Meta-World's expert jerks the peg so that it slips. Once the peg hangs more than 2.5 cm below the hand, that expert
    goes down to it with closed fingers and drags it along the table for the rest of the episode.
    """

    above = 0.15
    """Metres above the peg at which the hand approaches."""
    aside = 0.04
    """Horizontal metres from the peg beyond which the hand goes above it."""
    held = 0.04
    """Metres below the hand down to which a peg is in the fingers."""
    open, shut = 0.6, 0.4
    """Gripper openings. Above `open` the hand may go down, below `shut` the fingers hold the peg."""
    aligned = 0.03
    """Metres from the hole's axis within which the peg may go in."""
    carry = 0.7
    """Largest action of a hand that carries."""
    before, behind, height = 0.05, -0.35, 0.16
    """Position of the hand in metres: x before the hole and behind it, and z."""

    def get_action(self, state: Array) -> Array:
        """Return the action (4,) at a state (39,), not clipped."""
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
"""Name of these experts in recordings and in the identity of `policy=expert`. Raise it when their actions change."""

OURS: Mapping[str, Callable[[], HandlePullSide | PegInsertSide]] = {
    "handle-pull-side-v3": HandlePullSide,
    "peg-insert-side-v3": PegInsertSide,
}
"""Task to the expert that replaces Meta-World's."""
