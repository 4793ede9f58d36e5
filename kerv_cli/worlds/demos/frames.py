"""Frames of demonstrations as PNG in the episodes' files, read and decoded on access. Training keeps none of them in
memory and no file open, so it does not depend on the size of the dataset."""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kerv_cli.base.errors import CheckpointError

LENGTH = struct.Struct("<Q")  # a safetensors file starts with its header's length


class EncodedFrames:
    """n frames (size, width, 3) uint8. sources: the files; sources[source[i]] holds the PNG of frame i at start[i] …
    end[i], which may be wider."""

    def __init__(
        self,
        sources: Sequence[Path],
        source: NDArray[np.int64],
        start: NDArray[np.int64],
        end: NDArray[np.int64],
        size: int,
        width: int,
    ) -> None:
        self.sources, self.source, self.start, self.end = sources, source, start, end
        self.size, self.width = size, width

    @classmethod
    def of_file(cls, path: Path, offsets: NDArray[np.int64], size: int, width: int = 0) -> EncodedFrames:
        """The frames of an episode's file; offsets (n + 1,): in its tensor `png`. width: default `size`.

        Raises:
            CheckpointError: the file has no such bytes.
        """
        try:
            with path.open("rb") as file:
                length = file.read(LENGTH.size)
                header, begin = header_of(length + file.read(LENGTH.unpack(length)[0]))
            first, last = header["png"]["data_offsets"]
        except (OSError, ValueError, KeyError, TypeError, struct.error) as error:
            raise CheckpointError(f"{path} is missing or damaged: {error}") from error
        positions = offsets + begin + first
        if len(offsets) < 1 or (np.diff(offsets) <= 0).any() or offsets[0] < 0 or offsets[-1] > last - first:
            raise CheckpointError(f"{path} is damaged: its frames lie outside their tensor")
        return cls([path], np.zeros(len(offsets) - 1, np.int64), positions[:-1], positions[1:], size, width or size)

    @classmethod
    def joined(cls, parts: Sequence[EncodedFrames]) -> EncodedFrames:
        """All frames of `parts`, in order."""
        sources = [source for part in parts for source in part.sources]
        first = np.cumsum([0, *(len(part.sources) for part in parts)])
        columns = [(part.source + base, part.start, part.end) for part, base in zip(parts, first, strict=False)]
        source, start, end = (np.concatenate(column) for column in zip(*columns, strict=True))
        return cls(sources, source, start, end, parts[0].size, parts[0].width)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(n, size, width, 3)."""
        return len(self), self.size, self.width, 3

    def __len__(self) -> int:
        return len(self.source)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return (self[i] for i in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self.pixels().astype(dtype or np.uint8, copy=False)

    @overload
    def __getitem__(self, chosen: int) -> NDArray[np.uint8]: ...

    @overload
    def __getitem__(self, chosen: Any) -> EncodedFrames: ...

    def __getitem__(self, chosen: Any) -> NDArray[np.uint8] | EncodedFrames:
        """One frame, decoded, or those that a slice, mask or indices select, still encoded."""
        if isinstance(chosen, int | np.integer):
            return self._decode(int(chosen))
        at = np.asarray(chosen) if not isinstance(chosen, slice) else chosen
        return EncodedFrames(self.sources, self.source[at], self.start[at], self.end[at], self.size, self.width)

    def left(self, width: int) -> EncodedFrames:
        """The same frames without what lies right of `width` pixels: the first views of several."""
        return EncodedFrames(self.sources, self.source, self.start, self.end, self.size, width)

    def pixels(self) -> NDArray[np.uint8]:
        """(n, size, width, 3), decoded on as many threads as this process may use.

        Raises:
            CheckpointError: a frame is damaged.
        """
        if not len(self):
            return np.zeros(self.shape, np.uint8)
        workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        if workers == 1 or len(self) < 16:
            return np.stack([self._decode(i) for i in range(len(self))])
        with ThreadPoolExecutor(min(workers, 8)) as pool:
            return np.stack(list(pool.map(self._decode, range(len(self)))))

    def _decode(self, i: int) -> NDArray[np.uint8]:
        path, start = self.sources[self.source[i]], int(self.start[i])
        try:
            with path.open("rb") as file:
                file.seek(start)
                data = file.read(int(self.end[i]) - start)
            with Image.open(io.BytesIO(data)) as image:
                return np.array(image)[:, : self.width]  # a copy: torch warns of memory that may not be written to
        except (OSError, SyntaxError, ValueError) as error:
            raise CheckpointError(f"a frame of the demonstrations in {path} is damaged: {error}") from error


def header_of(data: bytes) -> tuple[dict[str, Any], int]:
    """The header of a safetensors file, and where its arrays begin; data: the file's bytes.

    Raises:
        struct.error, ValueError: it has none.
    """
    begin = LENGTH.size + LENGTH.unpack(data[: LENGTH.size])[0]
    return json.loads(data[LENGTH.size : begin]), begin


def encode_png(frame: NDArray[np.uint8]) -> bytes:
    """frame (h, w, 3) uint8 -> PNG."""
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()
