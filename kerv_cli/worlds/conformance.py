"""Checks that an environment keeps the protocols of worlds and experts, on one task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kerv_cli.base.findings import Failed, Finding, run
from kerv_cli.base.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec, World

STEPS = 5  # control steps of every check
SIZE = 48  # pixels of a frame


def check_environment(spec: EnvironmentSpec, seed: int) -> list[Finding]:
    """One finding per check, on the specification's first task. seed: of the episodes."""
    trial = Trial(spec, next(iter(spec.tasks)), seed)
    checks: list[tuple[str, Callable[[], str]]] = [
        ("same seed, same episode", trial.repeats),
        ("another seed, another start", trial.differs),
        ("observation", trial.observation),
        ("frames", trial.frames),
    ]
    return run(checks) + (run([("expert", trial.expert)]) if spec.expert_class else [])


@dataclass
class Trial:
    """The checks of one task."""

    spec: EnvironmentSpec
    task: str
    seed: int

    def open(self) -> World:
        """A fresh world of the task."""
        return self.spec.open_world(self.task, CameraSettings(size=SIZE))

    def trace(self, seed: int, drawn: bool) -> np.ndarray:
        """States (STEPS + 1, s) of an episode with seeded actions."""
        random, space = np.random.default_rng(7), self.spec.actions
        with self.open() as world:
            states = [world.reset(seed).state]
            for _ in range(STEPS):
                if drawn:
                    world.frame()
                states.append(world.step(random.uniform(space.low, space.high)).state)
        return np.array(states)

    def repeats(self) -> str:
        """Two episodes of one seed are equal to the last bit, whether frames are drawn or not."""
        first, second = self.trace(self.seed, False), self.trace(self.seed, True)
        if not np.array_equal(first, second):
            raise Failed(f"two episodes of seed {self.seed} differ by {np.abs(first - second).max():.3g}")
        return f"{STEPS} steps, with and without frames"

    def differs(self) -> str:
        """Three seeds do not all begin with one initial state."""
        starts = []
        with self.open() as world:
            for seed in range(self.seed, self.seed + 3):
                world.reset(seed)
                starts.append(tuple(np.asarray(world.initial_state).tolist()))
        if len(set(starts)) < 2:
            raise Failed("three seeds begin with the same initial_state: pairs of episodes could not be told apart")
        return f"{len(set(starts))} of 3 seeds begin differently"

    def observation(self) -> str:
        """Shapes are as specified, and the state begins with the proprioception."""
        space = self.spec.observation
        with self.open() as world:
            observation = world.reset(self.seed)
            state, proprioception = observation.state, observation.proprioception
            if state.shape != (space.state,) or proprioception.shape != (len(space.proprioception),):
                raise Failed(f"state {state.shape}, proprioception {proprioception.shape}: not as specified")
            if not np.array_equal(state[: len(proprioception)], proprioception):
                raise Failed("the state does not begin with the proprioception")
            if world.end_effector.shape != (3,) or not 0 <= world.gripper <= 1:
                raise Failed(
                    f"end_effector {world.end_effector.shape}, gripper {world.gripper}: (3,) and 0 to 1 wanted"
                )
            return f"instruction '{world.instruction}'"

    def frames(self) -> str:
        """Every camera draws a frame of the right shape that is not of one colour."""
        with self.open() as world:
            world.reset(self.seed)
            for name, image in world.observe(self.spec.cameras).images.items():
                if image.shape != (SIZE, SIZE, 3) or image.dtype != np.uint8:
                    raise Failed(
                        f"camera {name} draws {image.shape} {image.dtype}, ({SIZE}, {SIZE}, 3) uint8 is wanted"
                    )
                if not image.std():
                    raise Failed(f"camera {name} draws one colour")
        return ", ".join(self.spec.cameras)

    def expert(self) -> str:
        """The expert's actions lie within the limits."""
        expert, space = self.spec.expert(self.task), self.spec.actions
        with self.open() as world:
            observation = world.reset(self.seed)
            for _ in range(STEPS):
                action = np.asarray(expert(observation))
                if action.shape != (space.dofs,) or (action < space.low).any() or (action > space.high).any():
                    raise Failed(f"an action of shape {action.shape} or outside the limits")
                observation = world.step(action)
        return f"{STEPS} actions within the limits"
