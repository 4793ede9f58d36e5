"""Run one episode: world + decoder -> EpisodeRecord."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kerv_cli.decoding.record import DecodeRecord, EpisodeRecord
from kerv_cli.environments.camera import CameraConfig
from kerv_cli.environments.spec import World
from kerv_cli.spaces import Observation


class ActionDecoder(Protocol):
    """What an episode needs of a decoder."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the images that decode() reads; no others are drawn for it."""

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """A new episode begins, with the end effector at (3,) metres: histories are cleared."""

    def decode(self, observation: Observation) -> DecodeRecord:
        """What is known now, with the images of `cameras` -> the actions to execute and all that happened."""

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """An action (D,) was executed and the end effector is now at (3,) metres."""

    def finish(self, success: bool) -> None:
        """The episode ended."""


@dataclass(frozen=True)
class Recording:
    """What of an episode is kept besides its record: frames of every step at this camera, or nothing."""

    camera: CameraConfig | None = None


class _Trace:
    """What the loop gathers step by step: executed actions, positions, gripper and logged frames."""

    def __init__(self, world: World, camera: CameraConfig | None) -> None:
        self.world, self.camera = world, camera
        self.actions: list[np.ndarray] = []  # (D,) float32, within the limits
        self.path: list[np.ndarray] = []
        self.gripper: list[float] = []
        self.frames: dict[int, np.ndarray] = {}
        self._look()

    def add(self, action: np.ndarray) -> None:
        """Executes `action` and keeps what followed."""
        self.world.step(action)
        space = self.world.spec.actions
        self.actions.append(np.clip(action, space.low, space.high).astype(np.float32))
        self._look()

    def _look(self) -> None:
        self.path.append(self.world.end_effector)
        self.gripper.append(self.world.gripper)
        if self.camera:
            self.frames[len(self.actions)] = self.world.frame(self.camera)


def run_episode(world: World, decoder: ActionDecoder, seed: int, recording: Recording | None = None) -> EpisodeRecord:
    """One episode, closed loop: decode a chunk, execute it whole, until success or the horizon.

    Simulation and rendering lie outside the decoder and so outside inference time.
    """
    began = time.perf_counter()
    world.reset(seed)
    decoder.reset(world.task, seed, world.end_effector)
    trace = _Trace(world, recording.camera if recording else None)
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
        wall_seconds=time.perf_counter() - began,
    )
