"""The specification of Meta-World v3."""

from __future__ import annotations

from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace, Place
from kerv_cli.worlds.metaworld.experts import OURS, VERSION
from kerv_cli.worlds.metaworld.tasks import DIFFICULTIES, SUFFIX, SUITES, TASKS
from kerv_cli.worlds.spec import EnvironmentSpec

_OBJECTS = 18  # numbers of a time step: hand xyz, gripper opening, then position and rotation of two objects

SPEC = EnvironmentSpec(
    name="metaworld",
    actions=ActionSpace(
        # hand displacement per axis (1 is 1 cm) and gripper (+1 closes)
        names=("dx", "dy", "dz", "gripper"),
        groups=(Group("position", 3), Group("gripper", 1)),
        strict=("gripper",),
        control_hz=80.0,
        low=(-1.0, -1.0, -1.0, -1.0),
        high=(1.0, 1.0, 1.0, 1.0),
    ),
    observation=ObservationSpace(
        # hand [0:4], first object [4:11], second object [11:18], the step before's 18 numbers [18:36], goal [36:39]
        proprioception=("x", "y", "z", "gripper"),
        state=39,
        places=(Place("object", 4), Place("goal", 36)),
        centre=(0.0, 0.7, 0.15),
        extra_places=(Place("second object", 11),),
        extra=tuple(range(7, _OBJECTS)),
        previous=(_OBJECTS, _OBJECTS),
    ),
    tasks=TASKS,
    suites=SUITES,
    difficulties=DIFFICULTIES,
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
