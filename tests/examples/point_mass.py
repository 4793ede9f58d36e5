"""A whole environment in one file, without a simulator: a point on a plane that is pushed to a goal.

`KERV_PLUGINS=examples.point_mass kerv rollout task=POINT policy=expert` runs it; this file's folder must be importable.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.spaces import ActionSpace, Group, Observation, ObservationSpace, Place
from kerv_cli.worlds import EnvironmentPart, Task
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec, Seeds, World

NEAR = 0.01  # metres from the goal that count as there

SPEC = EnvironmentSpec(
    name="point-mass",
    actions=ActionSpace(
        names=("dx", "dy"),
        groups=(Group("position", 2),),
        strict=(),
        control_hz=10.0,
        low=(-0.05, -0.05),  # metres
        high=(0.05, 0.05),
    ),
    observation=ObservationSpace(
        proprioception=("x", "y", "z"), state=6, places=(Place("goal", 3),), centre=(0.0, 0.0, 0.0)
    ),
    tasks={"push-point": Task("push-point", "push the point to the goal")},
    suites={"POINT": ("push-point",)},
    horizon=60,
    cameras=("above",),
    seeds=Seeds(training=range(50_000), selection=range(50_000, 100_000), evaluation=range(100_000, 2**31)),
    world_class=f"{__name__}:PointWorld",
    expert_class=f"{__name__}:PointExpert",
)
EnvironmentPart(SPEC.name)(lambda: SPEC)


class PointWorld(World):
    """The state is the point and the goal, (x, y, z) each; z is 0."""

    def _start(self, seed: int) -> NDArray[np.float64]:
        self._state = np.zeros(6)
        self._state[[0, 1, 3, 4]] = np.random.default_rng(seed).uniform(-0.5, 0.5, 4)
        self._placement = self._state.copy()
        return self._state.copy()

    def _advance(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
        self._state[:2] += action
        return self._state.copy(), bool(np.linalg.norm(self._state[:3] - self._state[3:]) < NEAR)

    def _draw(self, camera: CameraSettings) -> NDArray[np.uint8]:
        frame = np.full((camera.size, camera.size, 3), 255, dtype=np.uint8)
        for (x, y), colour in ((self._state[3:5], (0, 160, 0)), (self._state[:2], (200, 0, 0))):
            row, column = (np.clip([0.5 - y / 1.2, 0.5 + x / 1.2], 0, 0.99) * camera.size).astype(int)
            frame[row, column] = colour
        return frame

    @property
    def initial_state(self) -> NDArray[np.float64]:
        return self._placement.copy()


class PointExpert:
    """Straight to the goal."""

    def __init__(self, spec: EnvironmentSpec, task: str) -> None:
        self._limits = spec.actions.low, spec.actions.high

    def __call__(self, observation: Observation) -> NDArray[np.float64]:
        return np.clip(observation.state[3:5] - observation.state[:2], *self._limits)
