"""Run one episode: world + decoder -> EpisodeRecord."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np

from kerv_cli.decoding.record import DecodeRecord, EpisodeRecord
from kerv_cli.environments.camera import CameraConfig
from kerv_cli.environments.spec import World
from kerv_cli.spaces import Observation


class ActionDecoder(Protocol):
    """The interface of a decoder to an episode."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras whose images decode() reads; no others are drawn for it."""

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """Begins an episode: clears histories."""

    def decode(self, observation: Observation) -> DecodeRecord:
        """The present observation, with the images of `cameras` -> the actions to execute and their record."""

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """Told after each executed action (D,), in environment units; end_effector (3,) is its position now, metres."""

    def finish(self, success: bool) -> None:
        """Told at the end of the episode."""


class _Trace:
    """Collects executed actions, end-effector positions, gripper openings, frames and places, step by step."""

    def __init__(self, world: World, camera: CameraConfig | None) -> None:
        self.world, self.camera = world, camera
        self.actions: list[np.ndarray] = []  # (D,) float32, within the limits
        self.path: list[np.ndarray] = []
        self.gripper: list[float] = []
        self.frames: dict[int, np.ndarray] = {}
        self.places: dict[str, list[np.ndarray]] = {}
        self._look()

    def add(self, action: np.ndarray) -> None:
        """Executes `action` and stores the result."""
        self.world.step(action)
        space = self.world.spec.actions
        self.actions.append(np.clip(action, space.low, space.high).astype(np.float32))
        self._look()

    def _look(self) -> None:
        self.path.append(self.world.end_effector)
        self.gripper.append(self.world.gripper)
        if self.camera:
            self.frames[len(self.actions)] = self.world.frame(self.camera)
            state = np.asarray(self.world.observe(()).state)
            for place in self.world.spec.observation.places:
                self.places.setdefault(place.name, []).append(state[place.first : place.first + 3])


def run_episode(world: World, decoder: ActionDecoder, seed: int, camera: CameraConfig | None = None) -> EpisodeRecord:
    """One closed-loop episode: decodes a chunk, executes it whole, until success or the horizon.

    Simulation and rendering happen outside the decoder and so outside inference time. camera: the view whose frames the
    record keeps, one per control step; None: none.
    """
    began = time.perf_counter()
    world.reset(seed)
    decoder.reset(world.task, seed, world.end_effector)
    trace = _Trace(world, camera)
    decodes: list[DecodeRecord] = []
    decode_steps: list[int] = []
    while not world.done:
        decodes.append(decoder.decode(world.observe(decoder.cameras)))
        decode_steps.append(len(trace.actions))
        for action in decodes[-1].actions:
            trace.add(action)
            decoder.observe(trace.actions[-1], trace.path[-1])
            if world.done:
                break
    decoder.finish(world.succeeded)
    return EpisodeRecord(
        environment=world.spec.name,
        space=world.spec.actions,
        task=world.task,
        instruction=world.instruction,
        seed=seed,
        success=world.succeeded,
        steps=len(trace.actions),
        decodes=tuple(decodes),
        decode_steps=tuple(decode_steps),
        actions=np.stack(trace.actions),
        path=np.stack(trace.path).astype(np.float32),
        gripper=np.asarray(trace.gripper, dtype=np.float32),
        initial_state=world.initial_state,
        frames=trace.frames,
        places={name: np.asarray(path, dtype=np.float32) for name, path in trace.places.items()},
        wall_seconds=time.perf_counter() - began,
    )
