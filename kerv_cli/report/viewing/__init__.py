"""Recordings of episodes for the Rerun viewer. Nothing heavy is imported here."""

from __future__ import annotations

from pathlib import Path

from kerv_cli.base.files import write_bytes
from kerv_cli.engine.record import EpisodeRecord


def save_recording(record: EpisodeRecord, path: Path, method: str) -> Path:
    """Write an episode atomically as a recording that carries its own layout, and return the path.

    Args:
        record: The episode; without frames, the recording has no camera.
        path: The .rrd file; its folder is created.
        method: Name of the method. Recordings of one method share their layout in the viewer.

    Raises:
        StorageError: The disk is full or read-only, or the folder may not be written to.
    """
    from kerv_cli.report.viewing.rerun_log import encode

    write_bytes(path, encode(record, method))
    return path
