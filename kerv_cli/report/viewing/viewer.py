"""Find, check, read and open recordings, and make films of them. Rerun is imported only when a file is read."""

from __future__ import annotations

import functools
import io
import itertools
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image

from kerv_cli.base.errors import KervError, UsageError

if TYPE_CHECKING:
    from rerun.chunk import Chunk, RrdReader

# Recordings that one command opens. More would fill the viewer's memory.
MOST_OPENED = 16
NO_RECORDINGS = "no recordings in {}: make some with 'kerv rollout method=ar task=reach-v3'"
# Of a film file. A higher number makes the file too large.
FRAMES_PER_SECOND = 12
_START_SECONDS = 2.0


def recordings_below(folder: Path) -> Iterator[Path]:
    """Yield the .rrd files in a folder and its subfolders, except hidden files. Unreadable folders are left out."""
    return filter(Path.is_file, folder.rglob("[!.]*.rrd"))


def find_recordings(paths: Iterable[Path]) -> list[Path]:
    paths, found = [Path(path).expanduser() for path in paths], set[Path]()
    for path in paths:
        if path.is_dir():
            found.update(recordings_below(path))
        elif path.suffix == ".rrd" and path.exists():
            found.add(path)
        else:
            raise UsageError(f"{path} does not exist or is no recording: name a file that ends in .rrd, or a folder")
    if not found:
        where = ", ".join(map(str, paths)) or "the results folder"
        raise UsageError(NO_RECORDINGS.format(where))
    return sorted(found, key=lambda path: (-path.stat().st_mtime, path))


def has_display() -> bool:
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_recording(paths: Sequence[Path]) -> str:
    """Open recordings in the Rerun viewer, at most MOST_OPENED. Do not wait until the viewer is closed.

    Returns:
        A sentence about what was opened. If this machine has no display, the commands to type on another machine.
    """
    chosen = paths[:MOST_OPENED]
    for path in chosen:
        read_chunks(path)
    more = f" (the newest {len(chosen)} of {len(paths)})" if len(paths) > len(chosen) else ""
    if not has_display():
        own = dict(zip(chosen, map(_own_name, chosen), strict=True))
        lines = [shlex.join(["scp", f"{socket.gethostname()}:{path.absolute()}", name]) for path, name in own.items()]
        lines += [shlex.join(["rerun", *own.values()])]
        where = "no display here{}: type on a machine that has one (pip install 'rerun-sdk==0.41.*')"
        return "\n  ".join([where.format(more), *lines])
    _start([*viewer_command(), "--bind", "127.0.0.1", *map(str, chosen)])
    names = chosen[0].name if len(chosen) == 1 else f"{len(chosen)} recordings"
    return f"opened {names}{more} in the Rerun viewer"


def _own_name(path: Path) -> str:
    return f"{path.parent.parent.name}-{path.name}" if path.parent.name == "rollouts" else path.name


def viewer_command() -> list[str]:
    return [sys.executable, "-m", "rerun"]


def _start(command: list[str]) -> None:
    with tempfile.TemporaryFile() as log:
        try:
            viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
            status = viewer.wait(timeout=_START_SECONDS)
        except subprocess.TimeoutExpired:
            viewer.returncode = 0  # the viewer keeps running: without this, Popen would warn
            return
        except OSError as error:
            raise KervError(f"cannot start the Rerun viewer {command[0]}: {error.strerror}") from error
        if status:
            log.seek(0)
            lines = log.read().decode(errors="replace").strip().splitlines() or [f"exit status {status}"]
            raise KervError(f"the Rerun viewer ended at once: {lines[-1]}")


def read_chunks(path: Path) -> tuple[RrdReader, list[Chunk]]:
    """Read a recording. Return Rerun's reader and all data chunks of the file."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # rerun only warns if the end of the file is missing
        try:
            reader = RrdReader(path)
            chunks = list(reader.stream())
        except (RuntimeError, OSError, ValueError, Warning) as error:
            reason = "its end is missing" if isinstance(error, Warning) else str(error).splitlines()[0]
            raise KervError(f"{path} is damaged ({reason}): record the episode again") from error
    if not reader.recordings():
        raise KervError(f"{path} holds no recording: record the episode again")
    return reader, chunks


@dataclass(frozen=True)
class Film:
    """Images and facts of a recorded episode."""

    # JPEG images, one before the first control step and one after each. Empty if no camera was recorded.
    frames: tuple[bytes, ...]
    hz: float  # control steps per second
    # totals of the episode, as `token_outcomes.facts_of` computed them, and `tokens`, a hash of all tokens
    facts: dict[str, Any]
    changed: int  # time when the recording was written, in nanoseconds


def film_of(path: Path) -> Film:
    """Read the images of a recording. The four films that were read last stay in memory."""
    changed = path.stat().st_mtime_ns if path.exists() else 0
    return _read(path, changed)


@functools.lru_cache(maxsize=4)
def _read(path: Path, changed: int) -> Film:
    frames: dict[int, bytes] = {}
    facts: dict[str, Any] = {}
    hz = 1.0
    for chunk in read_chunks(path)[1]:
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/camera" and not chunk.is_static:
            images = batch["EncodedImage:blob"].flatten()
            data, ends = images.values.to_numpy(), images.offsets.to_pylist()
            steps = batch["step"].cast("int64").to_pylist()
            for step, (first, last) in zip(steps, itertools.pairwise(ends), strict=True):
                frames[step] = data[first:last].tobytes()
            if steps[-1]:
                hz = 1e9 * steps[-1] / batch["time"].cast("int64")[-1].as_py()
        elif chunk.entity_path == "/__properties/episode":
            for name in batch.schema.names:
                if not name.startswith("rerun."):
                    facts[name] = batch[name][0].as_py()[0]
    return Film(tuple(map(frames.__getitem__, sorted(frames))), hz, facts, changed)


def animation(film: Film, slower: float = 1.0) -> bytes:
    """Return a film, which must have frames, as a WebP image that plays again and again.

    Args:
        slower: How many times slower the film plays than the robot moved.
    """
    hz = film.hz / slower
    each = max(1, round(hz / FRAMES_PER_SECOND))
    first, *others = [Image.open(io.BytesIO(frame)) for frame in film.frames[::each]]
    buffer = io.BytesIO()
    first.save(buffer, "webp", save_all=True, append_images=others, duration=round(1000 * each / hz), loop=0)
    return buffer.getvalue()
