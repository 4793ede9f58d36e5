"""Write demonstrations as a LeRobot dataset. It has one row per recorded image, with PNG images inside the tables.

`action` is the expert's action without noise, `action.executed` the action that moved the robot. `observation.state` is
the proprioception, `observation.environment_state` the privileged state. If images were recorded only at every n-th
control step, the other steps have no rows and the dataset's rate is lower.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import atomic_path, visible, write_folder, write_json
from kerv_cli.worlds import instruction_of
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode
from kerv_cli.worlds.demos.frames import encode_png
from kerv_cli.worlds.demos.lerobot import layout
from kerv_cli.worlds.views import VIEWS

PICTURE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])


@dataclass
class Export:
    """A LeRobot dataset that is being written.

    Attributes:
        dataset: The demonstrations.
        tasks: Task -> its index.
        rate: Rows per second.
        episodes: Rows of the table of episodes so far.
        values: Feature -> its numbers (n, d) in each episode so far, for the statistics.
        rows: Number of rows so far.
        image_shape: (height, width, channels) of an image.
    """

    dataset: DemoDataset
    tasks: dict[str, int]
    rate: float
    episodes: list[dict[str, Any]] = field(default_factory=list)
    values: dict[str, list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))
    rows: int = 0
    image_shape: tuple[int, ...] = ()

    @property
    def image_keys(self) -> list[str]:
        """Name of the image feature of each view."""
        return [f"{layout.IMAGES}{view}" for view in self.dataset.manifest.config["camera"]["name"].split(VIEWS)]

    def write(self, folder: Path, progress: OnProgress) -> None:
        """Write all files. Each episode is a row group.

        The description meta/info.json comes last. Without it, a folder is no dataset.

        Args:
            folder: Folder of the LeRobot dataset.
            progress: Called after every episode.
        """
        path = folder / layout.DATA.format(chunk_index=0, file_index=0)
        total = len(self.dataset.episodes)
        with atomic_path(path) as temporary:
            first = self.table(self.dataset.load(0))
            with pq.ParquetWriter(temporary, first.schema, compression="snappy") as writer:
                for index in range(total):
                    writer.write_table(self.table(self.dataset.load(index)) if index else first)
                    progress(index + 1, total)
        names = pd.Index([instruction_of(task) for task in self.tasks], name="task")
        with atomic_path(folder / layout.TASKS) as temporary:
            pd.DataFrame({"task_index": list(self.tasks.values())}, index=names).to_parquet(temporary)
        with atomic_path(folder / layout.EPISODES.format(chunk_index=0, file_index=0)) as temporary:
            pq.write_table(pa.Table.from_pylist(self.episodes), temporary)
        write_json(folder / layout.STATS, {name: self.statistics(name) for name in self.values})
        write_json(folder / layout.INFO, self.info())

    def table(self, episode: DemoEpisode) -> pa.Table:
        """Return the rows of an episode, and add the episode to the table of episodes and the statistics."""
        steps, columns = episode.frame_steps, {}
        keys, width = self.image_keys, len(self.dataset.manifest.observation.proprioception)
        for key, frames in zip(keys, np.split(np.asarray(episode.frames), len(keys), axis=2), strict=True):
            columns[key] = pa.array([{"bytes": encode_png(frame), "path": None} for frame in frames], PICTURE)
            self.values[key].append(frames[:: layout.EVERY_FRAME, :: layout.EVERY_PIXEL, :: layout.EVERY_PIXEL])
            self.image_shape = frames.shape[1:]
        vectors: dict[str, np.ndarray] = {
            layout.STATE: episode.states[steps, :width],
            layout.ENVIRONMENT: episode.states[steps],
            layout.ACTION: episode.labels[steps],
            layout.EXECUTED: episode.executed[steps],
        }
        for name, values in vectors.items():
            columns[name] = pa.FixedSizeListArray.from_arrays(
                pa.array(values.astype(np.float32).ravel()), values.shape[1]
            )
        count, number = len(steps), len(self.episodes)
        counters: dict[str, np.ndarray] = {
            "timestamp": (np.arange(count) / self.rate).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(self.rows, self.rows + count),
            "task_index": np.full(count, self.tasks[episode.task]),
        }
        for name, values in (vectors | counters).items():
            self.values[name].append(values)
        episode_entry = {
            "episode_index": number,
            "tasks": [instruction_of(episode.task)],
            "length": count,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": self.rows,
            "dataset_to_index": self.rows + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        self.episodes.append(episode_entry)
        self.rows += count
        return pa.table({**columns, layout.DONE: np.arange(count) == count - 1, **counters})

    def statistics(self, name: str) -> dict[str, Any]:
        """Return the statistics of a feature for meta/stats.json."""
        values = np.concatenate(self.values[name]).astype(np.float64)
        shape: tuple[int, ...] = (-1,)
        if name in self.image_keys:
            values, shape = values.reshape(-1, 3) / 255, (3, 1, 1)
        found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        return {key: np.reshape(x, shape).tolist() for key, x in found.items()} | {"count": [len(values)]}

    def info(self) -> dict[str, Any]:
        """Return the contents of meta/info.json."""
        manifest = self.dataset.manifest
        image = {"dtype": "image", "shape": list(self.image_shape), "names": ["height", "width", "channels"]}
        vectors = {
            layout.STATE: manifest.observation.proprioception,
            layout.ENVIRONMENT: [f"state_{i}" for i in range(manifest.observation.state)],
            layout.ACTION: manifest.actions.names,
            layout.EXECUTED: manifest.actions.names,
        }
        scalars = {layout.DONE: "bool", "timestamp": "float32", **dict.fromkeys(layout.COUNTERS[1:], "int64")}
        return {
            "codebase_version": layout.VERSION,
            "robot_type": manifest.environment,
            "total_episodes": len(self.episodes),
            "total_frames": self.rows,
            "total_tasks": len(self.tasks),
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": int(self.rate) if self.rate == int(self.rate) else self.rate,
            "splits": {"train": f"0:{len(self.episodes)}"},
            "data_path": layout.DATA,
            "video_path": layout.VIDEO,
            "features": {
                **dict.fromkeys(self.image_keys, image),
                **{k: {"dtype": "float32", "shape": [len(v)], "names": list(v)} for k, v in vectors.items()},
                **{name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in scalars.items()},
            },
        }


def export(dataset: DemoDataset, folder: Path, progress: OnProgress) -> Export:
    """Write demonstrations as a LeRobot dataset.

    Args:
        dataset: The demonstrations.
        folder: Folder of the LeRobot dataset. An older dataset in it is replaced.
        progress: Called after every episode.

    Raises:
        UsageError: `folder` holds something else, or two tasks have the same instruction.
        CheckpointError: An episode is damaged.
        StorageError: Writing failed.
    """
    if visible(folder) and not (folder / "meta").is_dir():
        raise UsageError(f"{folder} exists and is no LeRobot dataset: name another folder")
    names = dict.fromkeys(entry.task for entry in dataset.episodes)
    if len({instruction_of(name) for name in names}) < len(names):
        raise UsageError("LeRobot tells tasks apart by their instruction, but two are the same: export them separately")
    rate = dataset.manifest.actions.control_hz / int(dataset.manifest.config["frame_stride"])
    result = Export(dataset, {name: number for number, name in enumerate(names)}, rate)
    write_folder(folder, lambda new: result.write(new, progress), replace=True)
    return result
