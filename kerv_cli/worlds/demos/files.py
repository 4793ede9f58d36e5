"""Read and write episode files, and read Parquet files that other programs wrote.

An episode file is a safetensors file with lossless PNG images (docs/formats.md).
"""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import atomic_path

FORMAT = "1"  # of the episode files
# same names in the file; `initial_state` is called `rand_vec` there
_ARRAYS = ("frame_steps", "states", "labels", "executed")


@dataclass(frozen=True)
class DemoEpisode:
    """A demonstration of T control steps, which ends with the first success.

    If an actor (such as a policy) moved the robot instead of the expert, the episode may end without success.
    """

    task: str
    seed: int
    # whether noise was added to the executed actions, or an actor moved the robot instead of the expert
    perturbed: bool
    steps: int
    # (n, size, size x views, 3) uint8. An episode that will only be saved may have an iterator of images instead.
    frames: NDArray[np.uint8] | EncodedFrames
    frame_steps: NDArray[np.int64]  # (n,) int64. Image i was drawn before the action of control step `frame_steps[i]`.
    # (T, s) float32, privileged state before each action. It begins with the proprioception.
    states: NDArray[np.float32]
    # (T + tail, D) float32, the expert's actions for D DoFs, clipped and without noise. The expert executed the last
    # `tail` actions after the episode's end. In imported data, they are copies of the last recorded action.
    labels: NDArray[np.float32]
    executed: NDArray[np.float32]  # (T, D) float32, the actions that moved the robot
    # (k,) float64, the world's `initial_state`, such as the placement of object and goal
    initial_state: NDArray[np.float64]

    @property
    def end_effector(self) -> NDArray[np.float32]:
        """Position before each action, (T, 3) float32, in metres."""
        return self.states[:, :3]


def save_episode(path: Path, episode: DemoEpisode, level: int = 6) -> None:
    """Write an episode to a file, atomically (docs/formats.md). Memory holds one image at a time.

    Args:
        level: Compression of the images, from 1 (five times as fast, 7 % more bytes) to 9. Equal recordings must have
            equal bytes, so recordings always use the default.
    """
    with (
        atomic_path(path) as temporary,
        temporary.open("wb") as file,
        tempfile.TemporaryFile(dir=path.parent) as pictures,
    ):
        height, width, sizes = 0, 0, list[int]()
        for frame in episode.frames:
            height, width = frame.shape[:2] if not sizes else (height, width)
            if frame.shape[:2] != (height, width):
                found = f"{frame.shape[1]} x {frame.shape[0]}"
                raise ValueError(f"an image has {found} pixels, the first of its episode {width} x {height}")
            sizes.append(pictures.write(encode_png(frame, level)))
        metadata = {
            "format": FORMAT,
            "frame_size": str(height),
            "perturbed": str(episode.perturbed).lower(),
            "seed": str(episode.seed),
            "steps": str(episode.steps),
            "task": episode.task,
        }
        if width != height:  # older files have no width, and equal episodes must have equal bytes
            metadata["frame_width"] = str(width)
        tensors = {
            "png": np.zeros(0, np.uint8),  # the pictures follow, because safetensors writes tensors of bytes last
            "png_offsets": np.cumsum([0, *sizes], dtype=np.int64),
            **{name: getattr(episode, name) for name in _ARRAYS},
            "rand_vec": episode.initial_state,
        }
        # Not safetensors' save_file: on a full disk it raises its own type of error.
        data = save(tensors, metadata=metadata)
        start = LENGTH.size + LENGTH.unpack(data[: LENGTH.size])[0]
        header, begin = json.loads(data[LENGTH.size : start]), len(data) - start
        header["png"] |= {"shape": [sum(sizes)], "data_offsets": [begin, begin + sum(sizes)]}
        # safetensors writes the keys in random order, which would give equal recordings different hashes
        header["__metadata__"] = dict(sorted(metadata.items()))
        text = json.dumps(header, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 8)  # arrays start at a multiple of eight
        file.write(LENGTH.pack(len(text)) + text + data[start:])
        pictures.seek(0)
        shutil.copyfileobj(pictures, file)


def load_episode(path: Path) -> DemoEpisode:
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CheckpointError(f"{path} is not a demonstration episode of format {FORMAT}")
            arrays = {name: file.get_tensor(name) for name in _ARRAYS}
            arrays["initial_state"] = file.get_tensor("rand_vec")
            offsets = file.get_tensor("png_offsets")
        positions = path.stat().st_size - offsets[-1] + offsets  # the pictures are at the end of the file
        spans = np.stack([np.zeros(len(positions) - 1, np.int64), positions[:-1], positions[1:]], axis=1)
        height = int(metadata["frame_size"])
        return DemoEpisode(
            task=metadata["task"],
            seed=int(metadata["seed"]),
            perturbed=metadata["perturbed"] == "true",
            steps=int(metadata["steps"]),
            frames=EncodedFrames([path], spans, height, int(metadata.get("frame_width", height))),
            **arrays,
        )
    except (OSError, SafetensorError, LookupError, ValueError) as error:
        raise CheckpointError(f"{path} is missing or damaged: {error}") from error


LENGTH = struct.Struct("<Q")  # a safetensors file begins with the length of its header


class EncodedFrames:
    """Images (n, size, width, 3) uint8 that are decoded when they are used. A wider PNG is cut off at the right.

    `spans` (n, 3) int64 holds, for each image, the index of its file in `files`, the position of the PNG's first byte,
    and the position after its last byte.
    """

    def __init__(self, files: Sequence[Path], spans: NDArray[np.int64], size: int, width: int) -> None:
        self.files, self.spans, self.size, self.width = files, spans, size, width

    @classmethod
    def joined(cls, parts: Sequence[EncodedFrames]) -> EncodedFrames:
        files: list[Path] = []
        spans = []
        for part in parts:
            spans.append(part.spans + np.array([len(files), 0, 0]))
            files += part.files
        return cls(files, np.concatenate(spans), parts[0].size, parts[0].width)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        return len(self), self.size, self.width, 3

    def __len__(self) -> int:
        return len(self.spans)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return map(self._decode, range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self.pixels().astype(dtype or np.uint8, copy=False)

    def __getitem__(self, chosen: Any) -> Any:
        if isinstance(chosen, int | np.integer):
            return self._decode(int(chosen))
        rows = chosen if isinstance(chosen, slice) else np.asarray(chosen)
        return EncodedFrames(self.files, self.spans[rows], self.size, self.width)

    def pixels(self) -> NDArray[np.uint8]:
        """Decode all images (n, size, width, 3), on several threads if the process has several CPU cores."""
        if not len(self):
            return np.zeros(self.shape, np.uint8)
        threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        if threads == 1 or len(self) < 16:
            return np.stack(list(self))
        with ThreadPoolExecutor(min(threads, 8)) as pool:
            return np.stack(list(pool.map(self._decode, range(len(self)))))

    def _decode(self, i: int) -> NDArray[np.uint8]:
        file_index, start, end = self.spans[i].tolist()
        with self.files[file_index].open("rb") as file:
            file.seek(start)
            data = file.read(end - start)
        with Image.open(io.BytesIO(data)) as image:
            return np.array(image)[:, : self.width]  # a copy, because torch warns if memory is read-only


def encode_png(frame: NDArray[np.uint8], level: int = 6) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=level)
    return buffer.getvalue()


MOST_EXPANDED = 2**30  # bytes of a table in memory


def foreign_table(path: Path, columns: Sequence[str]) -> pa.Table:
    """Read columns of a Parquet file of another program, which may be huge in memory. Ignore those that it lacks."""
    total = 0
    with pq.ParquetFile(path) as file:
        chosen = [column for column in file.schema_arrow.names if column in columns]
        schema = pa.schema([file.schema_arrow.field(column) for column in chosen], file.schema_arrow.metadata)
        batches = []
        # few rows at a time, because a file expands as it is read
        for batch in file.iter_batches(256, None, chosen, use_threads=False):
            total += batch.nbytes
            if total > MOST_EXPANDED:
                raise ValueError(f"{path} expands to more than {MOST_EXPANDED // 2**20} MiB in memory: split it")
            batches.append(batch)
    return pa.Table.from_batches(batches, schema)
