"""Names and paths in a LeRobot dataset of version 3."""

VERSION = "v3.0"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
EPISODES, DATA = f"meta/episodes/{CHUNK}.parquet", f"data/{CHUNK}.parquet"
VIDEO = f"videos/{{video_key}}/{CHUNK}.mp4"
STATE, ENVIRONMENT, ACTION, EXECUTED = "observation.state", "observation.environment_state", "action", "action.executed"
IMAGES, DONE = "observation.images.", "next.done"
COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that every dataset has. Timestamps are in seconds since the start of the episode."""
EVERY_FRAME, EVERY_PIXEL = 10, 4
"""The statistics of images use only every tenth image, and every fourth pixel in each direction."""
