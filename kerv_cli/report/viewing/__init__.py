"""Save and show recordings of episodes with the Rerun viewer. Importing this package loads nothing heavy."""

from __future__ import annotations

from pathlib import Path

from kerv_cli.base.files import write_bytes
from kerv_cli.engine.record import EpisodeRecord


def save_recording(record: EpisodeRecord, path: Path, method: str) -> Path:
    """Write an episode as a recording for the Rerun viewer. Recordings of one `method` share their layout."""
    from kerv_cli.report.viewing.rerun_log import encode

    write_bytes(path, encode(record, method))
    return path
