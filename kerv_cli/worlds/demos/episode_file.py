"""One demonstration episode in memory and as a file: safetensors with PNG frames, lossless and compact."""

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
"""Format of episode files."""
_ARRAYS = {
    "frame_steps": "frame_steps",
    "states": "states",
    "labels": "labels",
    "executed": "executed",
    "initial_state": "rand_vec",  # its name in Meta-World
}
"""Attribute of an episode to the name of its tensor."""


@dataclass(frozen=True)
class DemoEpisode:
    """One successful episode of T control steps, up to and including the first success.

    Attributes:
        task: Full name of the task.
        seed: Seed of the episode.
        perturbed: Whether its execution was noisy.
        steps: T.
        frames: (n, size, size x views, 3) uint8: the frames before the actions of `frame_steps`.
        frame_steps: (n,) int64.
        states: (T, s) float32: privileged state before each action. It begins with the proprioception.
        labels: (T + tail, D) float32: the clean expert's clipped actions. The last `tail` are beyond the success.
        executed: (T, D) float32: the actions that moved the robot.
        initial_state: (n,) float64: the world's `initial_state`, e.g. placement of object and goal.
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
        """Position of the end effector before each action, (T, 3) float32, metres."""
        return self.states[:, :3]


def save_episode(path: Path, episode: DemoEpisode) -> None:
    """Write one episode, atomically. The PNGs of its frames are one tensor, with n + 1 offsets beside it.

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
        # square frames need no width, so that their files keep their bytes
        **({"frame_width": str(width)} if width != height else {}),
    }
    # save_file would hide a full disk behind an error type of its own.
    write_bytes(path, _with_sorted_metadata(save(tensors, metadata=metadata)))


def _with_sorted_metadata(data: bytes) -> bytes:
    """Sort the keys of the metadata in the bytes of a safetensors file.

    safetensors writes them in random order. Two recordings of one episode would have different hashes.
    """
    header, start = header_of(data)
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # arrays start at a multiple of eight
    return LENGTH.pack(len(text)) + text + data[start:]


def load_episode(path: Path) -> DemoEpisode:
    """Read one episode.

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
