"""Insertion: a free-flying gripper with OpenVLA's seven degrees of freedom, and a flat peg that fits a slot one way
only.

A simulator of one's own beside Meta-World, with other spaces and with tasks that need rotation.
`KERV_PLUGINS=examples.insertion kerv rollout task=INSERTION policy=expert` runs it; the folder above this one must be
importable.
"""

from __future__ import annotations

from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace, Place
from kerv_cli.worlds import EnvironmentPart, Task
from kerv_cli.worlds.spec import EnvironmentSpec

SPEC = EnvironmentSpec(
    name="insertion",
    actions=ActionSpace(
        # per control step: displacement in metres, rotation vector in radians, both in the world's axes; the gripper's
        # wanted opening, 0 closed, 1 open
        names=("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper"),
        groups=(Group("position", 3), Group("rotation", 3), Group("gripper", 1)),
        strict=("gripper",),
        control_hz=20.0,
        low=(-0.01, -0.01, -0.01, -0.06, -0.06, -0.06, 0.0),
        high=(0.01, 0.01, 0.01, 0.06, 0.06, 0.06, 1.0),
    ),
    observation=ObservationSpace(
        # hand [0:7]; peg [7:10] and mouth of the slot [10:13], m; rotation vectors of slot [13:16] and peg [16:19], rad
        proprioception=("x", "y", "z", "roll", "pitch", "yaw", "gripper"),
        state=19,
        places=(Place("peg", 7), Place("slot", 10)),
        centre=(0.0, 0.0, 0.12),
        extra=tuple(range(13, 19)),
    ),
    tasks={
        "insert-peg": Task("insert-peg", "turn the peg and push it into the tilted slot"),
        "fetch-peg": Task("fetch-peg", "pick up the peg and put it into the slot"),
    },
    suites={"INSERTION": ("insert-peg", "fetch-peg")},
    horizon=120,
    cameras=("front", "top", "wrist"),
    world_class=f"{__name__}.world:InsertionWorld",
    expert_class=f"{__name__}.expert:InsertionExpert",
    packages=("mujoco",),
    grip=(0.0, 1.0),
)
EnvironmentPart(SPEC.name)(lambda: SPEC)
