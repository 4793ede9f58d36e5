"""The constants of Meta-World v3."""

from __future__ import annotations

from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace, Place
from kerv_cli.worlds.metaworld.tasks import SUFFIX, SUITES, TASKS
from kerv_cli.worlds.metaworld.world import OURS, VERSION
from kerv_cli.worlds.spec import EnvironmentSpec

_STEP = 18  # numbers of a time step: hand xyz, gripper opening, then position and rotation of two objects

SPEC = EnvironmentSpec(
    name="metaworld",
    actions=ActionSpace(
        names=("dx", "dy", "dz", "gripper"),  # displacement of the hand (1 is 1 cm); +1 closes the gripper
        groups=(Group("position", 3), Group("gripper", 1)),
        strict=("gripper",),
        control_hz=80.0,
        low=(-1.0,) * 4,
        high=(1.0,) * 4,
    ),
    observation=ObservationSpace(
        # hand [0:4], first object [4:11], second object [11:18], the same one step earlier [18:36], goal [36:39]
        proprioception=("x", "y", "z", "gripper"),
        state=39,
        places=(Place("object", 4), Place("goal", 36)),
        centre=(0.0, 0.7, 0.15),
        extra_places=(Place("second object", 11),),
        extra=tuple(range(7, _STEP)),
        previous=(_STEP, _STEP),
    ),
    tasks=TASKS,
    suites=SUITES,
    horizon=500,  # the simulator raises at step 501
    # corner4 is the view that publications use
    cameras=("corner4", "corner", "corner2", "corner3", "topview", "behindGripper", "gripperPOV"),
    upside_down=("corner", "corner2", "corner3", "corner4"),
    world_class="kerv_cli.worlds.metaworld.world:MetaWorld",
    expert_class="kerv_cli.worlds.metaworld.world:MetaWorldExpert",
    suffix=SUFFIX,
    packages=("metaworld", "mujoco"),
    grip=(1.0, -1.0),
    experts=dict.fromkeys(OURS, VERSION),
)
