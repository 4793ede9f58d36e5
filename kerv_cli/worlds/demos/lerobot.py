"""Import LeRobot datasets of version 3 as demonstrations (docs/data.md).

Images may be in the tables or in video files. `action` holds the actions to imitate. `action.executed` holds the
actions that moved the robot. `observation.state` is the proprioception, `observation.environment_state` the privileged
state.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from PIL import Image, UnidentifiedImageError

from kerv_cli.base.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.base.files import read_mapping, regular, write_folder, write_json
from kerv_cli.base.places import as_path
from kerv_cli.base.registry import find, load
from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace, action_limits
from kerv_cli.worlds.demos.dataset import (
    FORMAT,
    DemoDataset,
    EpisodeEntry,
    OnProgress,
    check_recorded,
    episode_path,
    totals,
)
from kerv_cli.worlds.demos.files import MOST_EXPANDED, DemoEpisode, foreign_table, save_episode
from kerv_cli.worlds.settings import DemosImportSettings
from kerv_cli.worlds.spec import EnvironmentSpec

INFO, TASKS = "meta/info.json", "meta/tasks.parquet"
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{CHUNK}.parquet"
VIDEO = f"videos/{{video_key}}/{CHUNK}.mp4"
STATE, ENVIRONMENT, ACTION, EXECUTED = "observation.state", "observation.environment_state", "action", "action.executed"
IMAGES = "observation.images."

Row: TypeAlias = Mapping[str, Any]
"""A row of a table, or an object of a JSON file."""

VECTORS = (ACTION, EXECUTED, STATE, ENVIRONMENT)
MOST_NUMBERS = 65_536
"""Largest size of an action or a state: numbers per control step."""
MOST_NAMED = 2**26
"""Largest size of a table of episodes or tasks in memory, in bytes."""
_TEMPLATE = re.compile(r"([^{}]|\{video_key\}|\{(chunk|file)_index(:0?\d{1,2}d)?\}){1,1000}")

OPENVLA = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")


@dataclass(frozen=True)
class Source:
    """A LeRobot dataset to read.

    Attributes:
        folder: Folder of the dataset.
        info: Contents of meta/info.json.
        episodes: Rows of the tables in meta/episodes.
        tasks: The instructions by `task_index`, the number of a task.
        camera: Name of the camera to read.
        key: Name of the feature with the camera's images.
    """

    folder: Path
    info: Row
    episodes: Sequence[Row]
    tasks: Mapping[int, str]
    camera: str
    key: str

    @classmethod
    def open(cls, folder: Path, camera: str) -> Source:
        """Read the description of a dataset.

        Args:
            folder: Folder of the dataset.
            camera: Camera to read. Empty: the first.

        Raises:
            UsageError: `folder` is a file.
            CheckpointError: There is no dataset of version 3, or it is damaged.
            UnknownName: The dataset has no such camera.
        """
        if folder.is_file():
            raise UsageError(f"{folder} is a file: name the folder of a LeRobot dataset, which holds meta/")
        if not (folder / INFO).is_file():
            raise CheckpointError(
                f"{folder / INFO} is missing: source= names the folder of a LeRobot dataset of version 3, with meta/, "
                "data/ and videos/"
            )
        info = read_mapping(folder / INFO)
        version = str(info.get("codebase_version"))
        if not version.startswith("v3."):
            raise CheckpointError(
                f"{folder / INFO} is of version {version}, v3.x is read: convert it with LeRobot's own "
                "convert_dataset_v21_to_v30"
            )
        features = info["features"].items()
        keys = {n.removeprefix(IMAGES): n for n, feature in features if feature["dtype"] in ("image", "video")}
        if not keys or ACTION not in info["features"]:
            raise CheckpointError(f"{folder} has no images or no {ACTION}: a policy cannot be trained on it")
        if camera and camera not in keys:
            raise UnknownName("camera", camera, keys)
        camera = camera or next(iter(keys))
        camera_file = [f"videos/{keys[camera]}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
        columns = ["episode_index", "length", "data/chunk_index", "data/file_index", *camera_file]
        paths = sorted(folder.glob("meta/episodes/[!.]*/[!.]*.parquet"))
        tables = [_table(path, columns=columns, most=MOST_NAMED) for path in paths]
        rows = sorted((row for table in tables for row in table.to_pylist()), key=lambda row: row["episode_index"])
        if not rows:
            raise CheckpointError(f"{folder / 'meta/episodes'} is missing or names no episode: copy the dataset again")
        columns = ["task_index", "task", "__index_level_0__"]
        names = _table(folder / TASKS, columns=columns, most=MOST_NAMED).to_pylist()
        tasks = {int(row["task_index"]): str(row.get("task", row.get("__index_level_0__"))) for row in names}
        return cls(folder, info, rows, tasks, camera, keys[camera])

    def names(self, feature: str, prefix: str) -> list[str]:
        """Return a name for each number of a feature. Empty if the dataset does not have the feature.

        Args:
            feature: Name of the feature, such as `action`.
            prefix: If the dataset does not name all numbers, they are named `prefix`_0, `prefix`_1, ….

        Raises:
            CheckpointError: The feature has more than MOST_NUMBERS numbers.
        """
        entry = self.info["features"].get(feature)
        if entry is None:
            return []
        names, shape = entry.get("names"), entry["shape"]
        count = math.prod(map(int, shape)) if len(shape) < 9 else 0
        if not 0 < count <= MOST_NUMBERS:
            raise CheckpointError(
                f"{self.folder / INFO}: {feature} is of shape {str(shape)[:80]}, at most {MOST_NUMBERS} numbers are "
                "read"
            )
        if isinstance(names, dict):
            names = next(iter(names.values()), None)
        if not isinstance(names, list) or len(names) != count or len(set(names)) != count:
            return [f"{prefix}_{i}" for i in range(count)]
        return [str(name) for name in names]

    def path(self, episode: Row, columns: str, form: str) -> Path:
        """Return the path of a data or video file of an episode.

        Args:
            episode: The episode's row in meta/episodes.
            columns: Prefix of the two columns of that row that say which file it is. `data` stands for
                `data/chunk_index` and `data/file_index`.
            form: Template of the path, such as `DATA`.

        Raises:
            CheckpointError: The template is not of LeRobot's form, or leads out of the dataset.
        """
        if not _TEMPLATE.fullmatch(form):
            raise CheckpointError(f"{self.folder / INFO}: the template of a path, '{form[:80]}', is not like '{DATA}'")
        indices = {f"{x}_index": int(episode[f"{columns}/{x}_index"]) for x in ("chunk", "file")}
        return _below(self.folder, form.format(video_key=self.key, **indices))

    def table(self, episode: Row) -> pa.Table:
        """Return the rows of one episode, in order.

        Args:
            episode: The episode's row in meta/episodes.

        Raises:
            CheckpointError: Rows are missing, or the file is damaged.
        """
        path = self.path(episode, "data", self.info.get("data_path") or DATA)
        columns = ["episode_index", "task_index", *VECTORS, self.key]
        table = _table(path, ("episode_index", int(episode["episode_index"])), columns)
        if len(table) != int(episode["length"]):
            raise CheckpointError(f"{path} has {len(table)} rows of episode {episode['episode_index']}, not its length")
        return table

    def frames(self, episode: Row, table: pa.Table) -> np.ndarray:
        """Return the images (T, height, width, 3) uint8 of one episode.

        Args:
            episode: The episode's row in meta/episodes.
            table: The episode's rows, from `table`.

        Raises:
            CheckpointError: A file is missing or damaged, or the images take more than MOST_EXPANDED bytes in memory.
        """
        if self.info["features"][self.key]["dtype"] == "image":
            path = self.path(episode, "data", self.info.get("data_path") or DATA)
            pictures = (_picture(cell.as_py(), self.folder) for cell in table[self.key])
            return _decoded(pictures, len(table), path)
        path = self.path(episode, f"videos/{self.key}", self.info.get("video_path") or VIDEO)
        start, rate = float(episode[f"videos/{self.key}/from_timestamp"]), float(self.info["fps"])
        return _decoded(_video_frames(path, start, rate, len(table)), len(table), path)


def import_lerobot(settings: DemosImportSettings, folder: Path, progress: OnProgress) -> DemoDataset:
    """Convert a LeRobot dataset to demonstrations in a new folder, and open them.

    Args:
        settings: Settings of `kerv demos import`.
        folder: The new folder.
        progress: Called after every episode.

    Raises:
        UsageError: There is no LeRobot dataset, or the new folder exists already.
        UnknownName: The dataset has no such camera or strict DoF.
        CheckpointError: The dataset is damaged or of another version.
        KervError: The dataset contains videos, and the package av is not installed.
    """
    if folder.exists():
        raise UsageError(f"{folder} exists: give the new demonstrations another name")
    path = as_path(settings.source)
    try:
        source = Source.open(path, settings.camera)
        write_folder(folder, lambda new: _import(source, settings, new, progress))
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        why = " ".join(f"{type(error).__name__} {error}".split())[:120]
        raise CheckpointError(f"{path} is no dataset as LeRobot writes them, or damaged: {why}") from error
    return DemoDataset.open(folder)


def _import(source: Source, settings: DemosImportSettings, folder: Path, progress: OnProgress) -> None:
    """Write the demonstrations into an empty folder."""
    chosen = source.episodes[: settings.episodes or None]
    world = _world_of(source, settings)
    names = _task_names(source.tasks, world)
    environment = re.sub(r"\W+", "_", settings.name or source.folder.name).strip("_").lower() or "recorded"
    if world is None:
        check_recorded(environment)
    entries: dict[str, list[EpisodeEntry]] = {}
    limits: list[np.ndarray] = []
    state = 0
    for done, row in enumerate(chosen):
        episode = _episode(source, row, names, settings.tail)
        limits.append(np.stack([episode.executed.min(0), episode.executed.max(0)]))
        state = episode.states.shape[1]
        path = episode_path(folder, episode.task, episode.seed)
        save_episode(path, episode)
        entries.setdefault(episode.task, []).append(EpisodeEntry.of(path, episode))
        progress(done + 1, len(chosen))
    proprioception = tuple(source.names(STATE, "state")[:state])
    if world:
        space, instructions = world.actions, {}
        observation = _observation(source, state, world)
    else:
        space = action_space(source, settings, np.concatenate(limits))
        observation = ObservationSpace(proprioception, state, (), (0.0, 0.0, 0.0))
        instructions = {names[i]: text for i, text in source.tasks.items() if names[i] in entries}
    recording = {
        "format": FORMAT,
        "environment": world.name if world else environment,
        "config": {
            "source": str(source.folder.resolve()),
            "camera": {"name": source.camera},
            "frame_stride": 1,
            "tail": settings.tail,
            "tasks": list(entries),
        },
    }
    manifest = {
        **recording,
        "actions": space.as_dict(),
        "observation": observation.as_dict(),
        "versions": {"lerobot": str(source.info["codebase_version"])},
        **totals(entries, {}, missing=0),
        "instructions": instructions,
    }
    write_json(folder / "recording.json", recording)
    write_json(folder / "manifest.json", manifest)


def _world_of(source: Source, settings: DemosImportSettings) -> EnvironmentSpec | None:
    """Return the environment that the data were recorded in. None if the setting `environment` is empty.

    Raises:
        UnknownName: There is no such environment, or it has no such camera.
        UsageError: The dataset has another number of DoFs than the environment, or another rate.
    """
    if not settings.environment:
        return None
    spec: EnvironmentSpec = load(find("environment", settings.environment).build)
    spec.camera_name(source.camera)
    ours, theirs = (spec.actions.dofs, spec.actions.control_hz), (len(source.names(ACTION, "")), source.info["fps"])
    if ours != theirs:
        raise UsageError(
            f"environment={spec.name}: it has {ours[0]} DoFs and {ours[1]:g} control steps per second, the dataset "
            f"{theirs[0]} and {theirs[1]:g}"
        )
    return spec


def _observation(source: Source, state: int, world: EnvironmentSpec) -> ObservationSpace:
    """Return the observation space of a dataset that was recorded in an environment.

    If the dataset holds the whole state, it is the environment's space. If it holds only the robot's own state, it is
    the environment's space reduced to the proprioception.

    Args:
        source: The dataset.
        state: Number of state values in each row of the dataset.
        world: The environment.

    Raises:
        CheckpointError: `state` is the size of neither the whole state nor the proprioception.
    """
    whole = world.observation
    alone = whole.without_state()
    for space in (whole, alone):
        if space.state == state:
            return space
    raise CheckpointError(
        f"{source.folder} has {state} numbers of state, {world.name} has {alone.state} of proprioception "
        f"({STATE}) and {whole.state} in all ({ENVIRONMENT})"
    )


def _episode(source: Source, row: Row, names: Mapping[int, str], tail: int) -> DemoEpisode:
    """Convert one episode.

    Args:
        source: The LeRobot dataset.
        row: The episode's row in meta/episodes.
        names: The names of the tasks by `task_index`.
        tail: Number of copies of the last action to append to the labels.

    Raises:
        CheckpointError: Rows are missing, a file is damaged, or a number is not finite.
    """
    table = source.table(row)
    number = int(row["episode_index"])
    columns = {name: _vectors(table, name) for name in VECTORS if name in table.column_names}
    if not all(np.isfinite(values).all() for values in columns.values()):
        raise CheckpointError(f"episode {number} of {source.folder} holds numbers that are not finite")
    labels = columns[ACTION]
    states = columns.get(ENVIRONMENT, columns.get(STATE, np.zeros((len(table), 0), np.float32)))
    return DemoEpisode(
        task=names[int(table["task_index"][0].as_py())],
        seed=number,
        perturbed=False,
        steps=len(table),
        frames=source.frames(row, table),
        frame_steps=np.arange(len(table), dtype=np.int64),
        states=states,
        labels=np.concatenate([labels, np.repeat(labels[-1:], tail, 0)]),
        executed=columns.get(EXECUTED, labels),
        initial_state=states[0].astype(np.float64),
    )


def action_space(source: Source, settings: DemosImportSettings, actions: np.ndarray) -> ActionSpace:
    """Return the action space of a LeRobot dataset. Its limits are the smallest and largest recorded values.

    Args:
        source: The dataset.
        settings: Settings of `kerv demos import`: names of the DoFs, and strict DoFs (such as a gripper).
        actions: (n, D) recorded actions, among them the smallest and the largest value of each DoF.

    Raises:
        UsageError: `dofs=openvla` was chosen, but the actions do not have seven DoFs.
        UnknownName: A strict DoF does not exist.
    """
    names = tuple(source.names(ACTION, "action"))
    if settings.dofs == "openvla":
        if len(names) != len(OPENVLA):
            raise UsageError(f"dofs=openvla: the dataset has {len(names)} DoFs ({', '.join(names)}), OpenVLA has 7")
        names = OPENVLA
    grippers = [name for name in names if "gripper" in name.lower()]
    strict = tuple(grippers if settings.strict is None else settings.strict)
    for name in strict:
        if name not in names:
            raise UnknownName("strict DoF", name, names)
    low, high = action_limits(actions.min(0).astype(float), actions.max(0).astype(float))
    return ActionSpace(names, _groups(names, strict), strict, float(source.info["fps"]), low, high)


def _groups(names: Sequence[str], strict: Sequence[str]) -> tuple[Group, ...]:
    """Divide the DoFs into groups.

    If there are seven and only the last is strict, the groups are position, rotation and gripper. Otherwise,
    neighbouring DoFs of the same sort (strict or not strict) form one group.
    """
    if len(names) == 7 and tuple(strict) == tuple(names[-1:]):
        return Group("position", 3), Group("rotation", 3), Group("gripper", 1)
    runs = [(is_strict, len(list(run))) for is_strict, run in itertools.groupby(names, lambda name: name in strict)]
    return tuple(Group(f"{'strict' if is_strict else 'motion'}_{i}", n) for i, (is_strict, n) in enumerate(runs))


def _task_names(tasks: Mapping[int, str], world: EnvironmentSpec | None) -> dict[int, str]:
    """Return the names of a dataset's tasks by `task_index`.

    If the data belong to an environment of kerv, each name is the environment's task with the same instruction.
    Otherwise it is made from the instruction, in small letters and digits joined by `-`.

    Args:
        tasks: The instructions by `task_index`.
        world: The environment. None: the tasks belong to no environment of kerv.

    Raises:
        UsageError: The environment has no task with this instruction.
    """
    if world:
        known = {task.instruction: task.name for task in world.tasks.values()}
        for text in tasks.values():
            if text not in known:
                raise UsageError(f"environment={world.name}: it has no task with the instruction '{text}'")
        return {number: known[text] for number, text in tasks.items()}
    names: dict[int, str] = {}
    taken: set[str] = set()
    for number, text in tasks.items():
        name = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:60] or f"task-{number}"
        names[number] = name if name not in taken else f"{name}-{number}"
        taken.add(names[number])
    return names


def _below(folder: Path, name: str) -> Path:
    """Return the path `name` below a folder.

    Raises:
        CheckpointError: It leads out of the folder.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise CheckpointError(f"{folder} names a file outside its own folder, '{name[:80]}': it is not read")
    return folder / name


def _table(path: Path, where: tuple[str, Any] | None = None, columns: Sequence[str] = (), most: int = 0) -> pa.Table:
    """Read a Parquet file with `foreign_table`, which explains the arguments.

    Raises:
        CheckpointError: The file is missing or damaged.
    """
    try:
        return foreign_table(path, where, columns, most)
    except (OSError, ValueError) as error:
        why = str(error).replace(str(path), "it")[:120]
        raise CheckpointError(f"{path} is missing or damaged: {why}") from error


def _vectors(table: pa.Table, name: str) -> np.ndarray:
    """Return the numbers (T, n) float32 of a column, whose rows may be lists of lists.

    Raises:
        ValueError: The rows have different lengths, or more than MOST_NUMBERS numbers.
    """
    parts = []
    for part in filter(len, table[name].chunks):
        rows = len(part)
        while pa.types.is_nested(part.type):
            lengths = pc.unique(pc.list_value_length(part)).to_pylist()
            if len(lengths) > 1 or None in lengths:
                raise ValueError(f"the rows of {name} have different lengths")
            part = part.flatten()
        if len(part) > MOST_NUMBERS * rows:
            raise ValueError(f"{name} has {len(part) // rows} numbers per row, at most {MOST_NUMBERS} are read")
        parts.append(part.to_numpy(zero_copy_only=False).astype(np.float32).reshape(rows, -1))
    return np.concatenate(parts)


def _decoded(images: Iterator[np.ndarray], count: int, path: Path) -> np.ndarray:
    """Return `count` images as one array (count, height, width, 3) uint8.

    Raises:
        CheckpointError: They take more than MOST_EXPANDED bytes in memory.
    """
    first = next(images)
    if count * first.nbytes > MOST_EXPANDED:
        raise CheckpointError(
            f"{path}: the {count} images of an episode take {count * first.nbytes // 2**20} MiB in memory, at most "
            f"{MOST_EXPANDED // 2**20} are read: make them smaller"
        )
    frames = np.empty((count, *first.shape), np.uint8)
    for number, image in enumerate(itertools.chain([first], images)):
        frames[number] = image
    return frames


def _picture(cell: Row, folder: Path) -> np.ndarray:
    """Decode an image from a cell of a table, which holds the image's bytes or its path below `folder`."""
    data = cell.get("bytes")
    try:
        with Image.open(io.BytesIO(data) if data else regular(_below(folder, str(cell.get("path"))))) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise CheckpointError(f"an image in {folder} cannot be read: {str(error)[:120]}") from error


def _video_frames(path: Path, start: float, rate: float, count: int) -> Iterator[np.ndarray]:
    """Yield the frames of a video that are nearest to the times start, start + 1 / rate, ….

    Args:
        path: The video.
        start: First time, in seconds.
        rate: Frames per second.
        count: Number of frames.

    Raises:
        KervError: The package av is not installed.
        CheckpointError: The video is missing, damaged or too short.
    """
    try:
        import av
    except ImportError as error:
        raise KervError("datasets with videos need the package av: pip install 'kerv[lerobot]'") from error
    try:
        with av.open(str(regular(path))) as container:
            stream = container.streams.video[0]
            if start > 0:
                container.seek(int(start / float(stream.time_base)), stream=stream)
            done, half = 0, 0.5 / rate
            for frame in container.decode(stream):
                while done < count and float(frame.time) >= start + done / rate - half:
                    yield frame.to_ndarray(format="rgb24")
                    done += 1
                if done == count:
                    return
    except (av.error.FFmpegError, OSError) as error:
        raise CheckpointError(f"{path} is missing or damaged: {str(error)[:120]}") from error
    raise CheckpointError(f"{path} ends {count - done} frames before its episode does")
