"""Run one episode: world + decoder -> EpisodeRecord."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kerv_cli.decoding.record import DecodeRecord, EpisodeRecord
from kerv_cli.environments.camera import CameraConfig
from kerv_cli.environments.metaworld.world import World


class ActionDecoder(Protocol):
    """What an episode needs of a decoder."""

    @property
    def needs_frame(self) -> bool:
        """Whether decode() reads a frame; none is rendered otherwise."""

    def reset(self, task: str, instruction: str, seed: int) -> None:
        """A new episode begins: histories are cleared."""

    def decode(self, frame: np.ndarray | None, state: np.ndarray) -> DecodeRecord:
        """(h, w, 3) uint8 or None, (39,) float64 -> the actions to execute and all that happened."""

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """An action (D,) was executed and the end effector is now at (3,) metres."""

    def finish(self, success: bool) -> None:
        """The episode ended."""


@dataclass(frozen=True)
class Recording:
    """What of an episode is kept besides its record: frames of every step at this camera, or nothing."""

    camera: CameraConfig | None = None


def run_episode(world: World, decoder: ActionDecoder, seed: int, recording: Recording | None = None) -> EpisodeRecord:
    """One episode, closed loop: decode a chunk, execute it whole, until success or the horizon.

    Simulation and rendering lie outside the decoder and so outside inference time.
    """
    began = time.perf_counter()
    logged = recording.camera if recording else None
    observation = world.reset(seed)
    decoder.reset(world.task, world.instruction, seed)
    decodes: list[DecodeRecord] = []
    decode_steps: list[int] = []
    actions: list[np.ndarray] = []
    path, gripper = [world.end_effector], [float(observation.state[3])]
    frames: dict[int, np.ndarray] = {}
    if logged:
        frames[0] = world.frame(logged)
    while not world.done:
        frame = world.frame() if decoder.needs_frame else None
        record = decoder.decode(frame, observation.state)
        decodes.append(record)
        decode_steps.append(len(actions))
        for action in record.actions:
            observation = world.step(action)
            actions.append(np.clip(action, -1.0, 1.0).astype(np.float32))
            path.append(world.end_effector)
            gripper.append(float(observation.state[3]))
            decoder.observe(actions[-1], path[-1])
            if logged:
                frames[len(actions)] = world.frame(logged)
            if world.done:
                break
    decoder.finish(world.succeeded)
    return EpisodeRecord(
        task=world.task,
        instruction=world.instruction,
        seed=seed,
        success=world.succeeded,
        steps=len(actions),
        decodes=tuple(decodes),
        decode_steps=tuple(decode_steps),
        actions=np.stack(actions),
        path=np.stack(path).astype(np.float32),
        gripper=np.asarray(gripper, dtype=np.float32),
        initial_state=world.rand_vec,
        frames=frames,
        wall_seconds=time.perf_counter() - began,
    )
