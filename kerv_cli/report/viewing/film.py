"""Make films of recorded episodes, from the images in their recordings."""

from __future__ import annotations

import functools
import io
import itertools
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from PIL import Image

from kerv_cli.report.viewing.viewer import read_chunks

FRAMES_PER_SECOND = 12
"""Frames per second of a film file. More make it large."""


@dataclass(frozen=True)
class Film:
    """Images and facts of a recorded episode.

    Attributes:
        frames: JPEG images, one before the first control step and one after each. Empty if no camera was recorded.
        hz: Control steps per second.
        facts: Totals of the episode, as `token_outcomes.facts_of` computed them, and `tokens`, a hash of all tokens.
        changed: Time when the recording was written, in nanoseconds.
    """

    frames: tuple[bytes, ...]
    hz: float
    facts: dict[str, Any]
    changed: int


def film_of(path: Path) -> Film:
    """Read the images of a recording. The latest four recordings are kept in memory.

    Raises:
        KervError: The recording is missing or damaged.
    """
    changed = path.stat().st_mtime_ns if path.exists() else 0
    return _read(path, changed)


@functools.lru_cache(maxsize=4)
def _read(path: Path, changed: int) -> Film:
    frames: list[tuple[int, bytes]] = []
    facts: dict[str, Any] = {}
    hz = 1.0
    for chunk in read_chunks(path)[1]:
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/camera" and not chunk.is_static:
            images = batch["EncodedImage:blob"].flatten()
            data, ends = images.values.to_numpy(), images.offsets.to_pylist()
            blobs = [data[first:last].tobytes() for first, last in itertools.pairwise(ends)]
            steps = batch["step"].cast("int64").to_pylist()
            frames += zip(steps, blobs, strict=True)
            if steps[-1]:
                hz = 1e9 * steps[-1] / batch["time"].cast("int64")[-1].as_py()
        elif chunk.entity_path == "/__properties/episode":
            for name in batch.schema.names:
                if not name.startswith("rerun."):
                    facts[name] = batch[name][0].as_py()[0]
    return Film(tuple(map(itemgetter(1), sorted(frames))), hz, facts, changed)


def animation(film: Film, slower: float = 1.0) -> bytes:
    """Return a film as a GIF that plays again and again.

    Args:
        film: The film. It must have frames.
        slower: How many times slower than the robot moved.
    """
    hz = film.hz / slower
    each = max(1, round(hz / FRAMES_PER_SECOND))
    first, *others = [Image.open(io.BytesIO(frame)) for frame in film.frames[::each]]
    buffer = io.BytesIO()
    first.save(buffer, "gif", save_all=True, append_images=others, duration=round(1000 * each / hz), loop=0)
    return buffer.getvalue()
