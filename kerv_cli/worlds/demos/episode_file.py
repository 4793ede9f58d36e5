"""A demonstration episode in memory, and as a file: safetensors with lossless PNG images (docs/formats.md)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import write_bytes
from kerv_cli.worlds.demos.frames import LENGTH, EncodedFrames, encode_png, header_of

FORMAT = "1"
"""Version of the episode files' format."""
_ARRAYS = {
    "frame_steps": "frame_steps",
    "states": "states",
    "labels": "labels",
    "executed": "executed",
    "initial_state": "rand_vec",  # its name in Meta-World
}
"""Attribute of an episode -> name of its tensor in the file."""


@dataclass(frozen=True)
class DemoEpisode:
    """A demonstration of T control steps.

    It ends with the first success. If an actor moved the robot, it may end without success.

    Attributes:
        task: Full name of the task.
        seed: Seed of the episode.
        perturbed: Whether noise was added to the executed actions, or an actor moved the robot instead of the expert.
        steps: T.
        frames: (n, size, size x views, 3) uint8, the recorded images.
        frame_steps: (n,) int64. Image i was drawn before the action of control step `frame_steps[i]`.
        states: (T, s) float32, privileged state before each action. It begins with the proprioception.
        labels: (T + tail, D) float32, the expert's actions, clipped and without noise. The last `tail` actions come
            after the episode's end.
        executed: (T, D) float32, the actions that moved the robot.
        initial_state: (k,) float64, the world's `initial_state`, such as the placement of object and goal.
    """

    task: str
    seed: int
    perturbed: bool
    steps: int
    frames: NDArray[np.uint8] | EncodedFrames
    frame_steps: NDArray[np.int64]
    states: NDArray[np.float32]
    labels: NDArray[np.float32]
    executed: NDArray[np.float32]
    initial_state: NDArray[np.float64]

    @property
    def end_effector(self) -> NDArray[np.float32]:
        """Position of the end effector before each action, (T, 3) float32, in metres."""
        return self.states[:, :3]


def save_episode(path: Path, episode: DemoEpisode) -> None:
    """Write an episode to a file, atomically.

    The PNG files of all images are stored end to end in one tensor. Another tensor holds their n + 1 offsets.

    Raises:
        StorageError: Writing failed.
    """
    pictures = [encode_png(frame) for frame in episode.frames]
    tensors = {
        "png": np.frombuffer(b"".join(pictures), dtype=np.uint8),
        "png_offsets": np.cumsum([0, *map(len, pictures)], dtype=np.int64),
        **{name: getattr(episode, attribute) for attribute, name in _ARRAYS.items()},
    }
    height, width = episode.frames.shape[1:3]
    metadata = {
        "format": FORMAT,
        "task": episode.task,
        "seed": str(episode.seed),
        "perturbed": str(episode.perturbed).lower(),
        "steps": str(episode.steps),
        "frame_size": str(height),
        # no width for square frames: older files have none, and equal episodes must have equal bytes
        **({"frame_width": str(width)} if width != height else {}),
    }
    # Not safetensors' save_file: on a full disk it raises its own type of error.
    write_bytes(path, _with_sorted_metadata(save(tensors, metadata=metadata)))


def _with_sorted_metadata(data: bytes) -> bytes:
    """Sort the keys of the metadata in a safetensors file, given and returned as bytes.

    safetensors writes the keys in random order. Without sorting, two recordings of the same episode would have
    different hashes.
    """
    header, start = header_of(data)
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # arrays start at a multiple of eight
    return LENGTH.pack(len(text)) + text + data[start:]


def load_episode(path: Path) -> DemoEpisode:
    """Read an episode from a file.

    Raises:
        CheckpointError: The file is missing, damaged or of another format.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CheckpointError(f"{path} is not a demonstration episode of format {FORMAT}")
            arrays = {attribute: file.get_tensor(name) for attribute, name in _ARRAYS.items()}
            offsets = file.get_tensor("png_offsets")
        steps, seed = int(metadata["steps"]), int(metadata["seed"])
        frames = EncodedFrames.of_file(path, offsets, int(metadata["frame_size"]), int(metadata.get("frame_width", 0)))
        perturbed = metadata["perturbed"] == "true"
        return DemoEpisode(metadata["task"], seed, perturbed, steps, frames, **arrays)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise CheckpointError(f"{path} is missing or damaged: {error}") from error
