"""Finds, checks, reads and opens recordings. Rerun is imported only where a file is read."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.files import regular

if TYPE_CHECKING:
    from rerun.chunk import Chunk, RrdReader

MOST_OPENED = 16
"""Largest number of recordings that one command opens; more would fill the viewer's memory."""
_START_SECONDS = 2.0
_TIMELINES = ("step", "time")


def recordings_below(folder: Path) -> Iterator[Path]:
    """The .rrd files in a folder and its folders, without hidden ones."""
    return (path for path in folder.rglob("[!.]*.rrd") if path.is_file())


def find_recordings(paths: Sequence[Path]) -> list[Path]:
    """The .rrd files among `paths` and in its folders, the newest first.

    Raises:
        UsageError: a path does not exist or is neither a recording nor a folder, or there is no recording.
    """
    modified: dict[Path, float] = {}
    for path in (Path(p).expanduser() for p in paths):
        if path.is_dir():
            modified |= {file: file.stat().st_mtime for file in recordings_below(path)}
        elif not path.exists():
            raise UsageError(f"{path} does not exist: name a recording (.rrd) or a folder of them")
        elif path.suffix != ".rrd":
            raise UsageError(f"{path} is not a recording: its name does not end in .rrd")
        else:
            modified[path] = path.stat().st_mtime
    if not modified:
        where = ", ".join(str(p) for p in paths) or "nowhere"
        raise UsageError(f"no recordings in {where}: make some with 'kerv rollout method=ar task=reach-v3'")
    return sorted(modified, key=lambda path: (-modified[path], path))


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_recording(paths: Sequence[Path]) -> str:
    """Opens recordings in the Rerun viewer without waiting for it; without a display, names the commands that do.

    Args:
        paths: one recording or more, the newest first; at most MOST_OPENED are opened.

    Returns:
        A sentence about what was opened, or the commands to type.

    Raises:
        KervError: a recording is damaged, or the viewer did not start.
    """
    chosen = paths[:MOST_OPENED]
    for path in chosen:
        _reader(path)
    more = f" (the newest {len(chosen)} of {len(paths)})" if len(paths) > len(chosen) else ""
    if not has_display():
        command = f"rerun {' '.join(shlex.quote(path.name) for path in chosen)}"
        remedy = "copy the files to a machine that has one (pip install 'rerun-sdk==0.41.*')"
        return f"no display here{more}: {remedy}:\n  {command}"
    _start([*viewer_command(), "--bind", "127.0.0.1", *map(str, chosen)])
    names = chosen[0].name if len(chosen) == 1 else f"{len(chosen)} recordings"
    return f"opened {names}{more} in the Rerun viewer"


def viewer_command() -> list[str]:
    """The command of the viewer, preferably the one installed beside this Python."""
    beside = Path(sys.executable).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")
    if beside.is_file():
        return [str(beside)]
    executable = shutil.which("rerun")
    return [executable] if executable else [sys.executable, "-m", "rerun"]


def _start(command: list[str]) -> None:
    """Starts the viewer as a process of its own. KervError: it exited at once, with its last line."""
    with tempfile.TemporaryFile() as log:
        try:
            viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        except OSError as error:
            raise KervError(f"cannot start the Rerun viewer {command[0]}: {error.strerror}") from error
        try:
            status = viewer.wait(timeout=_START_SECONDS)
        except subprocess.TimeoutExpired:
            viewer.returncode = 0  # it outlives this process: Popen must not warn of it
            return
        if status:
            log.seek(0)
            told = log.read().decode(errors="replace").strip().splitlines() or [f"exit status {status}"]
            raise KervError(f"the Rerun viewer ended at once: {told[-1]}")


def read_recording(path: Path) -> dict[str, Any]:
    """The contents of a recording, read chunk by chunk.

    Returns:
        `application`, `recording` (ids), `name`, `bytes`, `blueprint` (whether it carries a layout), `episode` (the
        properties that save_episode wrote), `entities` (path -> rows that are not static), `timelines` (name ->
        (first, last): control steps, nanoseconds).

    Raises:
        KervError: the file is missing or damaged.
    """
    path = Path(path)
    reader = _reader(path)
    entry = reader.recordings()[0]
    name, episode = "", {}
    entities: dict[str, int] = {}
    timelines: dict[str, tuple[int, int]] = {}
    for chunk in _chunks(reader, path):
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/__properties/episode":
            episode = {f.name: batch[f.name][0].as_py()[0] for f in batch.schema if not f.name.startswith("rerun.")}
        elif chunk.entity_path.startswith("/__properties"):
            if "RecordingInfo:name" in batch.schema.names:
                name = batch["RecordingInfo:name"][0].as_py()[0]
        else:
            rows = 0 if chunk.is_static else chunk.num_rows
            entities[chunk.entity_path] = entities.get(chunk.entity_path, 0) + rows
            for timeline in _TIMELINES if rows else ():
                times = batch[timeline].cast("int64").to_numpy()
                first, last = timelines.get(timeline, (int(times[0]), int(times[0])))
                timelines[timeline] = min(first, int(times.min())), max(last, int(times.max()))
    return {
        "application": entry.application_id,
        "recording": entry.recording_id,
        "name": name,
        "bytes": path.stat().st_size,
        "blueprint": bool(reader.blueprints()),
        "episode": episode,
        "entities": dict(sorted(entities.items())),
        "timelines": timelines,
    }


def read_summary(path: Path) -> str:
    """`read_recording` as text; errors as there."""
    contents = read_recording(path)
    lines = [f"{path}: {contents['name'] or contents['recording']}, {contents['bytes'] / 1e6:.2f} MB"]
    if "step" in contents["timelines"]:
        first, last = contents["timelines"]["step"]
        lines[0] += f", steps {first} to {last}"
    lines += [f"  {key:<20} {_figure(value)}" for key, value in sorted(contents["episode"].items())]
    rows = ", ".join(f"{entity[1:]} {count}" for entity, count in contents["entities"].items() if count)
    lines.append(f"  rows: {rows}")
    return "\n".join(lines)


def _figure(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _reader(path: Path) -> RrdReader:
    """A reader of the file, whose header and footer are valid and which holds a recording.

    Raises:
        KervError: the file is missing, damaged or empty.
    """
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a footer is missing: the end of the file is
        try:
            reader = RrdReader(regular(path))
            recordings = reader.recordings()
        except FileNotFoundError as error:
            raise KervError(f"{path} is missing") from error
        except (RuntimeError, OSError, ValueError, Warning) as error:
            raise KervError(_damaged(path, error)) from error
    if not recordings:
        raise KervError(f"{path} holds no recording: record the episode again")
    return reader


def chunks_of(path: Path) -> list[Chunk]:
    """Every chunk of a recording. KervError: it is missing or damaged."""
    return _chunks(_reader(path), path)


def _chunks(reader: RrdReader, path: Path) -> list[Chunk]:
    try:
        return list(reader.stream())
    except (RuntimeError, OSError, ValueError) as error:
        raise KervError(_damaged(path, error)) from error


def _damaged(path: Path, error: Exception) -> str:
    reason = str(error).splitlines()[0].removeprefix(f"Failed to read RRD file at {path}: ")
    if isinstance(error, Warning):
        reason = "its end is missing"
    return f"{path} is damaged ({reason}): record the episode again"
