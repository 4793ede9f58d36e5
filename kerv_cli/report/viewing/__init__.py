"""Recordings of episodes for the Rerun viewer. Nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from kerv_cli.engine.record import EpisodeRecord


def save_recording(record: EpisodeRecord, path: Path, method: str, limits: Mapping[str, float]) -> None:
    """Writes an episode as a recording, see `rerun_log.save_episode`. Picklable; the first call imports Rerun."""
    from kerv_cli.report.viewing.rerun_log import save_episode

    save_episode(record, path, method=method, limits=limits)
