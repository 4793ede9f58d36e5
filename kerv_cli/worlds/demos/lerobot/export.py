"""Writes demonstrations as a LeRobot dataset: one row per recorded frame, PNG images inside the tables.

`action` is the clean expert's, `action.executed` what moved the robot, `observation.state` the proprioception,
`observation.environment_state` the privileged state. Where frames were recorded every few control steps, the rows
between them are left out and the rate is lower.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import atomic_path, visible, write_folder, write_json
from kerv_cli.base.views import VIEWS
from kerv_cli.worlds import instruction_of
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode
from kerv_cli.worlds.demos.frames import encode_png
from kerv_cli.worlds.demos.lerobot import layout

EVERY = 10  # statistics are computed from every tenth image


@dataclass
class Moments:
    """Running statistics of one feature: min, max, mean, standard deviation, count."""

    shape: tuple[int, ...] = ()
    low: np.ndarray | float = np.inf
    high: np.ndarray | float = -np.inf
    total: np.ndarray | float = 0.0
    squares: np.ndarray | float = 0.0
    count: int = 0

    def add(self, values: np.ndarray) -> None:
        """values (n, d)."""
        values = values.astype(np.float64)
        self.low, self.high = np.minimum(self.low, values.min(0)), np.maximum(self.high, values.max(0))
        self.total, self.squares = self.total + values.sum(0), self.squares + (values**2).sum(0)
        self.count += len(values)

    def plain(self) -> dict[str, Any]:
        """For stats.json."""
        mean = self.total / self.count
        std = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0))
        values = {"min": self.low, "max": self.high, "mean": mean, "std": std}
        shape = self.shape or (-1,)
        return {name: np.reshape(x, shape).tolist() for name, x in values.items()} | {"count": [self.count]}


@dataclass
class Export:
    """The state of an export of `dataset`: what was written so far."""

    dataset: DemoDataset
    camera: str
    rate: float
    tasks: dict[str, int]
    episodes: list[dict[str, Any]] = field(default_factory=list)
    moments: dict[str, Moments] = field(default_factory=dict)
    rows: int = 0
    size: tuple[int, ...] = ()

    @property
    def image_keys(self) -> list[str]:
        """The feature of each view of the frames."""
        return [f"{layout.IMAGES}{view}" for view in self.camera.split(VIEWS)]

    def columns(self, episode: DemoEpisode) -> dict[str, np.ndarray]:
        """Every numeric column of an episode (n, …), one row per frame."""
        steps = episode.frame_steps
        width = len(self.dataset.manifest.observation.proprioception)
        count = len(steps)
        done = np.zeros(count, dtype=bool)
        done[-1] = True
        return {
            layout.STATE: episode.states[steps, :width].astype(np.float32),
            layout.ENVIRONMENT: episode.states[steps].astype(np.float32),
            layout.ACTION: episode.labels[steps].astype(np.float32),
            layout.EXECUTED: episode.executed[steps].astype(np.float32),
            layout.DONE: done,
            "timestamp": (np.arange(count) / self.rate).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, len(self.episodes)),
            "index": np.arange(self.rows, self.rows + count),
            "task_index": np.full(count, self.tasks[episode.task]),
        }

    def table(self, episode: DemoEpisode, file: int) -> pa.Table:
        """The episode's rows as a pyarrow table; adds the episode's entry to `episodes`. file: number of its data
        file."""
        columns, arrays = self.columns(episode), {}
        for name, values in columns.items():
            if values.ndim == 2:
                arrays[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
            else:
                arrays[name] = pa.array(values)
            if name != layout.DONE:
                self.moments.setdefault(name, Moments()).add(values.reshape(len(values), -1))
        keys = self.image_keys
        for key, frames in zip(keys, np.split(np.asarray(episode.frames), len(keys), axis=2), strict=True):
            pictures = [{"bytes": encode_png(frame), "path": None} for frame in frames]
            arrays[key] = pa.array(pictures, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
            self.moments.setdefault(key, Moments((3, 1, 1))).add(frames[::EVERY].reshape(-1, 3) / 255)
            self.size = frames.shape[1:]
        self.episodes.append(
            {
                "episode_index": len(self.episodes),
                "tasks": [instruction_of(episode.task)],
                "length": len(episode.frames),
                "data/chunk_index": 0,
                "data/file_index": file,
                "dataset_from_index": self.rows,
                "dataset_to_index": self.rows + len(episode.frames),
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self.rows += len(episode.frames)
        order = [*keys, *(name for name in arrays if name not in (*layout.COUNTERS, *keys)), *layout.COUNTERS]
        return pa.table({name: arrays[name] for name in order})

    def write_data(self, folder: Path, progress: OnProgress) -> None:
        """All rows, a row group per episode, in files of at most about FILE_MB."""
        total, index, file = len(self.dataset.episodes), 0, 0
        while index < total:
            path = folder / layout.DATA.format(chunk_index=0, file_index=file)
            with atomic_path(path) as temporary, contextlib.ExitStack() as stack:
                writer, size = None, 0
                while index < total and size <= layout.FILE_MB * 2**20:
                    table = self.table(self.dataset.load(index), file)
                    writer = writer or stack.enter_context(
                        pq.ParquetWriter(temporary, table.schema, compression="snappy")
                    )
                    writer.write_table(table)
                    size, index = size + table.nbytes, index + 1
                    progress(index, total)
            file += 1

    def info(self) -> dict[str, Any]:
        """meta/info.json."""
        manifest = self.dataset.manifest
        observation, actions = manifest.observation, manifest.actions
        image = {"dtype": "image", "shape": list(self.size), "names": ["height", "width", "channels"]}
        vectors = {
            layout.STATE: observation.proprioception,
            layout.ENVIRONMENT: [f"state_{i}" for i in range(observation.state)],
            layout.ACTION: actions.names,
            layout.EXECUTED: actions.names,
        }
        features = {
            **dict.fromkeys(self.image_keys, image),
            **{
                name: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
                for name, names in vectors.items()
            },
            layout.DONE: {"dtype": "bool", "shape": [1], "names": None},
            **{name: {"dtype": "int64", "shape": [1], "names": None} for name in layout.COUNTERS},
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        }
        return {
            "codebase_version": layout.VERSION,
            "robot_type": manifest.environment,
            "total_episodes": len(self.episodes),
            "total_frames": self.rows,
            "total_tasks": len(self.tasks),
            "chunks_size": 1000,
            "data_files_size_in_mb": layout.FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": int(self.rate) if self.rate == int(self.rate) else self.rate,
            "splits": {"train": f"0:{len(self.episodes)}"},
            "data_path": layout.DATA,
            "video_path": layout.VIDEO,
            "features": features,
        }

    def write_meta(self, folder: Path) -> None:
        """Tasks, episodes, statistics and, last, the description: without it there is no dataset."""
        names = pd.Index([instruction_of(task) for task in self.tasks], name="task")
        with atomic_path(folder / layout.TASKS) as temporary:
            pd.DataFrame({"task_index": list(self.tasks.values())}, index=names).to_parquet(temporary)
        with atomic_path(folder / layout.EPISODES.format(chunk_index=0, file_index=0)) as temporary:
            pq.write_table(pa.Table.from_pylist(self.episodes), temporary)
        write_json(folder / layout.STATS, {name: moments.plain() for name, moments in self.moments.items()})
        write_json(folder / layout.INFO, self.info())


def export(dataset: DemoDataset, folder: Path, progress: OnProgress) -> Export:
    """Writes `dataset` as a LeRobot dataset to `folder`.

    Raises:
        UsageError: `folder` holds something else. CheckpointError: an episode is damaged. StorageError: writing failed.
    """
    if visible(folder) and not (folder / "meta").is_dir():
        raise UsageError(f"{folder} exists and is no LeRobot dataset: name another folder")
    config = dataset.manifest.config
    rate = dataset.manifest.actions.control_hz / int(config["frame_stride"])
    names = dict.fromkeys(entry.task for entry in dataset.episodes)
    if len({instruction_of(name) for name in names}) < len(names):
        raise UsageError("two tasks have the same instruction, which LeRobot tells tasks apart by: export them apart")
    tasks = {name: number for number, name in enumerate(names)}
    result = Export(dataset, config["camera"]["name"], rate, tasks)

    def fill(new: Path) -> None:
        result.write_data(new, progress)
        result.write_meta(new)

    write_folder(folder, fill, replace=True)
    return result
