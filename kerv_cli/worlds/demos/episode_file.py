"""One demonstration episode in memory and as a file: safetensors with PNG frames, lossless and compact."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import write_bytes
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.worlds.demos.frames import LENGTH, EncodedFrames, encode_png, header_of

FORMAT = 1
"""Format of episode files."""
_INITIAL_STATE = "rand_vec"  # name of the tensor in format 1, taken from Meta-World


@dataclass(frozen=True)
class DemoEpisode:
    """One successful episode of T control steps (up to and including the first success).

    Attributes:
        task, seed: of the episode. perturbed: whether its execution was noisy.
        steps: T.
        frames: (n, size, size x views, 3) uint8, the frames before the actions of `frame_steps`; encoded where loaded.
        frame_steps: (n,) int64.
        states: (T, s) float32, privileged state before each action; it begins with the proprioception.
        labels: (T + tail, D) float32, the clean expert's clipped actions; the last `tail` lie beyond the success.
        executed: (T, D) float32, the actions that moved the robot.
        initial_state: (n,) float64, of the world's `initial_state`, e.g. object and goal placement.
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
        """(T, 3) float32: position of the end effector before each action, metres."""
        return self.states[:, :3]


def save_episode(path: Path, episode: DemoEpisode) -> None:
    """Writes one episode, atomically; frames as PNG bytes, end to end, with n + 1 offsets.

    Raises:
        StorageError: writing failed.
    """
    pictures = [encode_png(frame) for frame in episode.frames]
    tensors = {
        "png": np.frombuffer(b"".join(pictures), dtype=np.uint8),
        "png_offsets": np.cumsum([0, *map(len, pictures)], dtype=np.int64),
        "frame_steps": episode.frame_steps,
        "states": episode.states,
        "labels": episode.labels,
        "executed": episode.executed,
        _INITIAL_STATE: episode.initial_state,
    }
    metadata = {
        "format": str(FORMAT),
        "task": episode.task,
        "seed": str(episode.seed),
        "perturbed": str(episode.perturbed).lower(),
        "steps": str(episode.steps),
        "frame_size": str(episode.frames.shape[1]),
    }
    height, width = episode.frames.shape[1:3]
    if width != height:  # square frames need no width, so that their files keep their bytes
        metadata["frame_width"] = str(width)
    # save_file would hide a full disk behind an error type of its own.
    write_bytes(path, _with_sorted_metadata(save(tensors, metadata=metadata)))


def _with_sorted_metadata(data: bytes) -> bytes:
    """Sorts the keys of the metadata in the bytes of a safetensors file. safetensors writes them in random order, so
    that the files of two recordings of one episode would have different hashes."""
    header, start = header_of(data)
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # arrays start at a multiple of eight
    return LENGTH.pack(len(text)) + text + data[start:]


def load_episode(path: Path, actions: ActionSpace, observation: ObservationSpace) -> DemoEpisode:
    """Reads one episode of an environment that has these spaces.

    Raises:
        CheckpointError: the file is missing, damaged, of another format or of other spaces.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != str(FORMAT):
                raise CheckpointError(f"{path} is not a demonstration episode of format {FORMAT}")
            names = [name for name in file.keys() if name != "png"]  # noqa: SIM118 - not a mapping
            arrays = {name: file.get_tensor(name) for name in names}
        width = int(metadata.get("frame_width", 0))
        frames = EncodedFrames.of_file(path, arrays["png_offsets"], int(metadata["frame_size"]), width)
        return _episode_from(arrays, frames, metadata, actions.dofs, observation.state)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise CheckpointError(f"{path} is missing or damaged: {error}") from error


def _episode_from(
    arrays: Mapping[str, NDArray[Any]], frames: EncodedFrames, metadata: Mapping[str, str], dofs: int, state: int
) -> DemoEpisode:
    steps = int(metadata["steps"])
    if arrays["states"].shape != (steps, state) or arrays["executed"].shape != (steps, dofs):
        raise ValueError(f"the arrays do not hold {steps} steps of {state} state numbers and {dofs} DoFs")
    labels = arrays["labels"]
    if len(labels) < steps or labels.shape[1:] != (dofs,) or len(arrays["frame_steps"]) != len(frames):
        raise ValueError("labels or frames are too few")
    return DemoEpisode(
        task=metadata["task"],
        seed=int(metadata["seed"]),
        perturbed=metadata["perturbed"] == "true",
        steps=steps,
        frames=frames,
        frame_steps=arrays["frame_steps"],
        states=arrays["states"],
        labels=labels,
        executed=arrays["executed"],
        initial_state=arrays[_INITIAL_STATE],
    )
