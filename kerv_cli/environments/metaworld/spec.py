"""Meta-World's spaces: what its robot observes and does."""

from __future__ import annotations

from kerv_cli.spaces import ActionSpace, Group, ObservationSpace, Place

ACTIONS = ActionSpace(
    names=("dx", "dy", "dz", "gripper"),
    groups=(Group("position", 3), Group("gripper", 1)),
    strict=("gripper",),
    control_hz=80.0,
    low=(-1.0,) * 4,
    high=(1.0,) * 4,
)
"""End-effector displacement per control step, and the gripper."""

OBSERVATION = ObservationSpace(
    proprioception=("x", "y", "z", "gripper"),
    state=39,
    places=(Place("object", 4), Place("goal", 36)),
    centre=(0.0, 0.7, 0.15),
    extra_places=(Place("second object", 11),),
    extra=tuple(range(7, 18)),  # rotation of the object, the second object
    previous=(18, 18),
)
"""The state holds hand, gripper, two objects, the same of the step before, and the goal."""
