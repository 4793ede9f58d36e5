"""Check that an environment keeps the rules for worlds and experts (`kerv doctor`), on its first task."""

from __future__ import annotations

import functools

import numpy as np

from kerv_cli.worlds.findings import Finding, find, need
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec, World

STEPS = 5  # control steps of every check
SIZE = 48  # pixels of a frame


def check_environment(spec: EnvironmentSpec, seed: int) -> list[Finding]:
    """Return one finding per check. Episodes have the seeds from `seed` on."""
    checks = {
        "same seed, same episode": _check_repeats,
        "another seed, another start": _check_starts_differ,
        "observation": _check_observation,
        "frames": _check_frames,
    }
    if spec.expert_class:
        checks["expert"] = _check_expert
    return [find(what, functools.partial(check, spec, seed)) for what, check in checks.items()]


def _open(spec: EnvironmentSpec) -> World:
    return spec.open_world(next(iter(spec.tasks)), CameraSettings(size=SIZE))


def _check_repeats(spec: EnvironmentSpec, seed: int) -> str:
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


def _check_starts_differ(spec: EnvironmentSpec, seed: int) -> str:
    starts = set()
    with _open(spec) as world:
        for one in range(seed, seed + 3):
            world.reset(one)
            starts.add(tuple(np.asarray(world.initial_state).tolist()))
    need(len(starts) > 1, "three seeds begin with the same initial_state: pairs of episodes could not be told apart")
    return f"{len(starts)} of 3 seeds begin differently"


def _check_observation(spec: EnvironmentSpec, seed: int) -> str:
    with _open(spec) as world:
        shape, wanted = world.reset(seed).state.shape, (spec.observation.state,)
        need(shape == wanted, f"the state has shape {shape}, not {wanted}")
        need(0 <= world.gripper <= 1, f"gripper is {world.gripper}, not between 0 and 1")
        return f"instruction '{world.instruction}'"


def _check_frames(spec: EnvironmentSpec, seed: int) -> str:
    with _open(spec) as world:
        world.reset(seed)
        for name, image in world.observe(spec.cameras).images.items():
            right = image.shape == (SIZE, SIZE, 3) and image.dtype == np.uint8
            need(right, f"camera {name} draws {image.shape} {image.dtype}, ({SIZE}, {SIZE}, 3) uint8 is wanted")
            need(image.std(), f"camera {name} draws one colour")
    return ", ".join(spec.cameras)


def _check_expert(spec: EnvironmentSpec, seed: int) -> str:
    with _open(spec) as world:
        expert, observation, space = spec.expert(world.task), world.reset(seed), spec.actions
        for _ in range(STEPS):
            action = np.asarray(expert(observation))
            within = action.shape == (space.dofs,) and (action >= space.low).all() and (action <= space.high).all()
            need(within, f"an action of shape {action.shape} or outside the limits")
            observation = world.step(action)
    return f"{STEPS} actions within the limits"
