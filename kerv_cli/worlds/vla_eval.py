"""Offer Meta-World as a benchmark of vla-eval: `benchmark: kerv_cli.worlds.vla_eval:MetaWorld` in its YAML file.

So every model server that takes an image, a sentence and four numbers of state can be tested on kerv's tasks, initial
states, cameras and stress. Episode i always has seed `seed` + i. So the episodes of different servers form pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.render import configure_mujoco_render
from vla_eval.specs import IMAGE_RGB, LANGUAGE, POSITION_DELTA, DimSpec

from kerv_cli.base.spaces import Observation
from kerv_cli.worlds import resolve_tasks, spec_of
from kerv_cli.worlds.settings import EVALUATION_SEED, CameraSettings, StressSettings
from kerv_cli.worlds.stress import build as build_stress


class MetaWorld(StepBenchmark):
    """Fifty manipulation tasks of a Sawyer arm in MuJoCo (Meta-World v3).

    Non-obvious behaviours:
        - An action is 4 numbers in [-1, 1]: hand displacement (1 is 1 cm) and gripper (+1 closes); 80 Hz.
        - An episode ends with the first step at which the task's success flag is set, or at the horizon (500).
        - Episode i starts from the initial state of seed `seed` + i. Seed and initial state are recorded as metrics.
        - Images are upright; several cameras joined with `+` are one image, side by side.
        - A stress disturbs the world (docs/stress.md). The disturbance is drawn from task and seed.

    Args:
        tasks: Tasks and suites, e.g. "reach" or ["MT10"].
        seed: Seed of the first episode of every task. Seeds from 100000 on are for evaluation.
        camera: corner4 (default), corner, corner2, corner3, topview, behindGripper or gripperPOV.
        image_size: Pixels of an image, square.
        horizon: Control steps of an episode. 0 means 500.
        stress: push, actuation, sensor, light, colour, camera or object.
        stress_level: 0 (none) to 4.
        send_images: Whether to draw an image at every step.
        privileged: Whether the state is all 39 numbers of the simulator, goal included, instead of the robot's 4.
    """

    _ALL_RECORD_FIELDS = frozenset({"success", "action", "state"})
    render_backends = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Choose MuJoCo's OpenGL backend. Return the environment variables for it."""
        return dict(configure_mujoco_render(mode))

    def __init__(
        self,
        tasks: str | Sequence[str] = ("MT10",),
        seed: int = EVALUATION_SEED,
        camera: str = "",
        image_size: int = 96,
        horizon: int = 0,
        stress: str = "none",
        stress_level: int = 0,
        send_images: bool = True,
        privileged: bool = False,
    ) -> None:
        """Check the arguments.

        Raises:
            UnknownName: There is no such task, camera or kind of stress.
            UsageError: A number is out of range.
        """
        super().__init__()
        self.tasks = resolve_tasks([tasks] if isinstance(tasks, str) else list(tasks))
        self.spec, self.seed = spec_of(self.tasks[0]), seed
        self.camera = self.spec.camera(CameraSettings(camera, size=image_size))
        self.horizon = self.spec.control_steps(horizon)
        settings = StressSettings(stress, stress_level)
        self.spec.check_stress(settings)
        self.stress, self.send_images, self.privileged = build_stress(settings), send_images, privileged
        self.world: Any = None  # a World from the first reset on

    def get_tasks(self) -> list[dict[str, Any]]:
        """Return the tasks. Each task's suite is the task's difficulty group."""
        tasks = (self.spec.tasks[name] for name in self.tasks)
        return [{"name": t.name, "suite": t.difficulty, "instruction": t.instruction, "seed": self.seed} for t in tasks]

    def reset(self, task: dict[str, Any]) -> Observation:
        """Start episode number `task["episode_idx"]` (default 0) of a task, and return the first observation."""
        if self.world is None or self.world.task != task["name"]:
            self.cleanup()
            self.world = self.spec.open_world(task["name"], self.camera, self.horizon)
            self.world.stress = self.stress
        return self.world.reset(self._seed(task))

    def _seed(self, task: dict[str, Any]) -> int:
        return self.seed + int(task.get("episode_idx", 0))

    def step(self, action: dict[str, Any]) -> StepResult:
        """Execute an action of 4 numbers.

        Raises:
            KervError: The action is not 4 finite numbers, or the episode has ended.
        """
        numbers = np.asarray(action.get("actions", action.get("action")), dtype=np.float64)
        observation, world = self.world.step(numbers), self.world
        self._recorder.record_step(success=world.succeeded, action=numbers, state=observation.proprioception)
        return StepResult(observation, float(world.success), world.done, {})

    def make_obs(self, raw_obs: Observation, task: dict[str, Any]) -> dict[str, Any]:
        """Return the observation in the form that is sent to the model server."""
        images = self.world.observe([self.camera.name]).images if self.send_images else {}
        state = raw_obs.state if self.privileged else raw_obs.proprioception
        return {"images": images, "task_description": self.world.instruction, "state": state}

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Return the success so far, the episode's seed and initial state, and the end effector's position."""
        world = self.world
        places = {"initial_state": world.initial_state.tolist(), "end_effector": world.end_effector.tolist()}
        return {"success": bool(world.succeeded), "seed": self._seed(self._task), **places}

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """Return an action that does not move the hand.

        Args:
            last_action: The previous action, whose gripper value is kept. If None, the gripper is opened.
        """
        action = self.spec.standstill(1.0)
        if last_action is not None:
            action[self.spec.actions.is_strict] = np.asarray(last_action["actions"])[self.spec.actions.is_strict]
        return {"actions": action}

    def get_metadata(self) -> dict[str, Any]:
        """Return `max_steps`, the horizon in control steps, and `control_hz`, the control rate in hertz."""
        return {"max_steps": self.horizon, "control_hz": self.spec.actions.control_hz}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Describe an action: displacement of the hand, and gripper."""
        return {"position": POSITION_DELTA, "gripper": DimSpec("gripper", 1, "binary_close_positive", (-1, 1))}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Describe an observation: one image, the instruction, and the robot's state."""
        names, numbers = self.spec.observation.proprioception, self.spec.observation.state
        state = (numbers, f"privileged{numbers}") if self.privileged else (len(names), "_".join(names))
        images = {self.camera.name: IMAGE_RGB} if self.send_images else {}
        return {**images, "language": LANGUAGE, "state": DimSpec("state", *state)}

    def render(self) -> np.ndarray | None:
        """Return the current image, or None before the first reset."""
        return None if self.world is None else self.world.frame()

    def cleanup(self) -> None:
        """Free the simulator."""
        if self.world is not None:
            self.world.close()
        self.world = None
