"""Images of demonstrations, which stay PNG files inside the episodes' files until they are used.

Training keeps no images in memory and no files open. So a dataset may have any size.
"""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

LENGTH = struct.Struct("<Q")  # a safetensors file begins with the length of its header


class EncodedFrames:
    """Images (n, size, width, 3) uint8 that are decoded when they are used.

    Attributes:
        files: Files that contain the PNG files.
        spans: (n, 3) int64. For each image: index into `files`, position of the PNG's first byte, position after its
            last.
        size: Height in pixels.
        width: Width in pixels. Parts of a PNG further to the right are cut off.
    """

    def __init__(self, files: Sequence[Path], spans: NDArray[np.int64], size: int, width: int) -> None:
        self.files, self.spans, self.size, self.width = files, spans, size, width

    @classmethod
    def of_file(cls, path: Path, offsets: NDArray[np.int64], size: int, width: int = 0) -> EncodedFrames:
        """Return the images of an episode's file without decoding them.

        Args:
            path: The file.
            offsets: (n + 1,) positions of the PNG files in the tensor `png`.
            size: Height in pixels.
            width: Width in pixels. 0: the images are square.
        """
        with path.open("rb") as file:
            length = file.read(LENGTH.size)
            header, begin = header_of(length + file.read(LENGTH.unpack(length)[0]))
        positions = offsets + begin + header["png"]["data_offsets"][0]
        spans = np.stack([np.zeros(len(offsets) - 1, np.int64), positions[:-1], positions[1:]], axis=1)
        return cls([path], spans, size, width or size)

    @classmethod
    def joined(cls, parts: Sequence[EncodedFrames]) -> EncodedFrames:
        """Return the images of all parts, in order. All parts must have the same size."""
        firsts = np.cumsum([0, *(len(part.files) for part in parts[:-1])])
        spans = np.concatenate(
            [part.spans + np.array([first, 0, 0]) for part, first in zip(parts, firsts, strict=True)]
        )
        return cls([file for part in parts for file in part.files], spans, parts[0].size, parts[0].width)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the decoded images, (n, size, width, 3)."""
        return len(self), self.size, self.width, 3

    def __len__(self) -> int:
        return len(self.spans)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return (self[i] for i in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self.pixels().astype(dtype or np.uint8, copy=False)

    def __getitem__(self, chosen: Any) -> Any:
        """Select images.

        An integer returns one decoded image (size, width, 3). A slice, mask or indices return the selected images as
        `EncodedFrames`, not decoded.
        """
        if isinstance(chosen, int | np.integer):
            return self._decode(int(chosen))
        rows = chosen if isinstance(chosen, slice) else np.asarray(chosen)
        return EncodedFrames(self.files, self.spans[rows], self.size, self.width)

    def left(self, width: int) -> EncodedFrames:
        """Return the same images, cut off at the right to a smaller `width`, so that only the first views remain."""
        return EncodedFrames(self.files, self.spans, self.size, width)

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
        """Return the decoded image number i."""
        file_index, start, end = self.spans[i].tolist()
        with self.files[file_index].open("rb") as file:
            file.seek(start)
            data = file.read(end - start)
        with Image.open(io.BytesIO(data)) as image:
            return np.array(image)[:, : self.width]  # a copy, because torch warns if memory is read-only


def header_of(data: bytes) -> tuple[dict[str, Any], int]:
    """Return the header of a safetensors file, and the position at which its arrays begin.

    Args:
        data: Bytes of the file. The header suffices.
    """
    begin = LENGTH.size + LENGTH.unpack(data[: LENGTH.size])[0]
    return json.loads(data[LENGTH.size : begin]), begin


def encode_png(frame: NDArray[np.uint8]) -> bytes:
    """Return an image (height, width, 3) uint8 as a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()
