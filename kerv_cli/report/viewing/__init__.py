"""Recordings of episodes for the Rerun viewer. Nothing heavy is imported here."""

from __future__ import annotations

from pathlib import Path

from kerv_cli.base.files import write_bytes
from kerv_cli.engine.record import EpisodeRecord


def save_recording(record: EpisodeRecord, path: Path, method: str) -> Path:
    """Writes an episode as a recording that carries its own layout, atomically -> `path`. The first call imports Rerun.

    Args:
        record: without frames, the recording has no camera.
        path: the .rrd file; its folder is created.
        method: name of the method, for the summary; recordings of one method share their layout in the viewer.

    Raises:
        StorageError: the disk is full or read-only, or the folder may not be written to.
    """
    from kerv_cli.report.viewing.rerun_log import encode

    write_bytes(path, encode(record, method))
    return path
