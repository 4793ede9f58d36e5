"""Names, paths and tables of a LeRobot dataset of version 3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

VERSION = "v3.0"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
EPISODES, DATA = f"meta/episodes/{CHUNK}.parquet", f"data/{CHUNK}.parquet"
VIDEO = f"videos/{{video_key}}/{CHUNK}.mp4"
STATE, ENVIRONMENT, ACTION, EXECUTED = "observation.state", "observation.environment_state", "action", "action.executed"
IMAGES, DONE = "observation.images.", "next.done"
COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that every dataset has; timestamps are seconds since the episode's start."""
FILE_MB = 100
"""Data files are begun anew from this size on."""


def data_path(folder: Path, file: int) -> Path:
    """Path of data file `file` of the first chunk."""
    return folder / DATA.format(chunk_index=0, file_index=file)


def numbers(dtype: str, names: list[str]) -> dict[str, Any]:
    """The feature of a vector with these names."""
    return {"dtype": dtype, "shape": [len(names)], "names": names}


def counters() -> dict[str, Any]:
    """The features of COUNTERS."""
    return {
        name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None} for name in COUNTERS
    }
