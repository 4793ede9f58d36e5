"""Checks that an environment keeps the protocols of worlds and experts, on one task."""

from __future__ import annotations

import functools

import numpy as np

from kerv_cli.base.findings import Finding, find, need
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec, World

STEPS = 5  # control steps of every check
SIZE = 48  # pixels of a frame


def check_environment(spec: EnvironmentSpec, seed: int) -> list[Finding]:
    """One finding per check, on the specification's first task. seed: of the episodes."""
    checks = {
        "same seed, same episode": _repeats,
        "another seed, another start": _differs,
        "observation": _observation,
        "frames": _frames,
    }
    if spec.expert_class:
        checks["expert"] = _expert
    return [find(what, functools.partial(check, spec, seed)) for what, check in checks.items()]


def _open(spec: EnvironmentSpec) -> World:
    return spec.open_world(next(iter(spec.tasks)), CameraSettings(size=SIZE))


def _repeats(spec: EnvironmentSpec, seed: int) -> str:
    """Two episodes of one seed are equal to the last bit, whether frames are drawn or not."""
    states: list[list[np.ndarray]] = [[], []]
    for drawn in (False, True):
        random = np.random.default_rng(7)
        with _open(spec) as world:
            states[drawn].append(world.reset(seed).state)
            for _ in range(STEPS):
                if drawn:
                    world.frame()
                states[drawn].append(world.step(random.uniform(spec.actions.low, spec.actions.high)).state)
    first, second = np.array(states)
    need(np.array_equal(first, second), f"two episodes of seed {seed} differ by {np.abs(first - second).max():.3g}")
    return f"{STEPS} steps, with and without frames"


def _differs(spec: EnvironmentSpec, seed: int) -> str:
    """Three seeds do not all begin with one initial state."""
    starts = set()
    with _open(spec) as world:
        for one in range(seed, seed + 3):
            world.reset(one)
            starts.add(tuple(np.asarray(world.initial_state).tolist()))
    need(len(starts) > 1, "three seeds begin with the same initial_state: pairs of episodes could not be told apart")
    return f"{len(starts)} of 3 seeds begin differently"


def _observation(spec: EnvironmentSpec, seed: int) -> str:
    """Shapes are as specified, and the state begins with the proprioception."""
    with _open(spec) as world:
        seen, space = world.reset(seed), spec.observation
        right = seen.state.shape == (space.state,) and seen.proprioception.shape == (len(space.proprioception),)
        need(right, f"state {seen.state.shape}, proprioception {seen.proprioception.shape}: not as specified")
        same = np.array_equal(seen.state[: len(seen.proprioception)], seen.proprioception)
        need(same, "the state does not begin with the proprioception")
        hand = f"end_effector {world.end_effector.shape}, gripper {world.gripper}: (3,) and 0 to 1 wanted"
        need(world.end_effector.shape == (3,) and 0 <= world.gripper <= 1, hand)
        return f"instruction '{world.instruction}'"


def _frames(spec: EnvironmentSpec, seed: int) -> str:
    """Every camera draws a frame of the right shape that is not of one colour."""
    with _open(spec) as world:
        world.reset(seed)
        for name, image in world.observe(spec.cameras).images.items():
            right = image.shape == (SIZE, SIZE, 3) and image.dtype == np.uint8
            need(right, f"camera {name} draws {image.shape} {image.dtype}, ({SIZE}, {SIZE}, 3) uint8 is wanted")
            need(image.std(), f"camera {name} draws one colour")
    return ", ".join(spec.cameras)


def _expert(spec: EnvironmentSpec, seed: int) -> str:
    """The expert's actions lie within the limits."""
    with _open(spec) as world:
        expert, observation, space = spec.expert(world.task), world.reset(seed), spec.actions
        for _ in range(STEPS):
            action = np.asarray(expert(observation))
            within = action.shape == (space.dofs,) and (action >= space.low).all() and (action <= space.high).all()
            need(within, f"an action of shape {action.shape} or outside the limits")
            observation = world.step(action)
    return f"{STEPS} actions within the limits"
