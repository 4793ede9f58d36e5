"""Import LeRobot datasets of version 3 as demonstrations (docs/data.md).

Images may be in the tables or in video files. `action` holds the actions to imitate. `action.executed` holds the
actions that moved the robot. `observation.state` is the proprioception, `observation.environment_state` the privileged
state.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from PIL import Image

from kerv_cli.base.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.base.files import read_mapping, write_folder, write_json
from kerv_cli.base.spaces import ActionSpace, Group, ObservationSpace, action_limits
from kerv_cli.worlds import EnvironmentPart, imported_name
from kerv_cli.worlds.demos.dataset import FORMAT, DemoDataset, EpisodeEntry, OnProgress, check_recorded, totals
from kerv_cli.worlds.demos.files import DemoEpisode, foreign_table
from kerv_cli.worlds.settings import DemosImportSettings
from kerv_cli.worlds.spec import EnvironmentSpec

INFO, TASKS = "meta/info.json", "meta/tasks.parquet"
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{CHUNK}.parquet"
VIDEO = f"videos/{{video_key}}/{CHUNK}.mp4"
STATE, ENVIRONMENT, ACTION, EXECUTED = "observation.state", "observation.environment_state", "action", "action.executed"
IMAGES = "observation.images."
VECTORS = (ACTION, EXECUTED, STATE, ENVIRONMENT)
MOST_NUMBERS = 65_536  # in the action or the state of one control step
OPENVLA = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
# PIL raises SyntaxError
_DAMAGE = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    SyntaxError,
    Image.DecompressionBombError,
    pa.ArrowException,
)

Row: TypeAlias = Mapping[str, Any]  # of a table, or an object of a JSON file


@dataclass(frozen=True)
class Source:
    """A LeRobot dataset to read."""

    folder: Path
    info: Row  # contents of meta/info.json
    episodes: Sequence[Row]  # rows of the tables in meta/episodes
    tasks: Mapping[int, str]  # the instructions by `task_index`
    camera: str
    key: str  # name of the feature with the camera's images

    @classmethod
    def open(cls, folder: Path, camera: str) -> Source:
        """Read the description of a dataset. An empty `camera` stands for the first camera."""
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
                f"{folder / INFO} is of version {version}, v3.x is read: convert a copy of {folder} with LeRobot, "
                "'python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/copy --root=COPY "
                "--push-to-hub=false'"
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
        rows: list[Row] = [row for path in paths for row in _table(path, columns).to_pylist()]
        if not rows:
            raise CheckpointError(f"{folder / 'meta/episodes'} is missing or names no episode: copy the dataset again")
        rows.sort(key=itemgetter("episode_index"))
        names = _table(folder / TASKS, ["task_index", "task", "__index_level_0__"]).to_pylist()
        tasks = {int(row["task_index"]): str(row.get("task", row.get("__index_level_0__"))) for row in names}
        return cls(folder, info, rows, tasks, camera, keys[camera])

    def names(self, feature: str, prefix: str = "") -> list[str]:
        """Return a name for each number of a feature: the dataset's own, or `prefix`_0, `prefix`_1, …."""
        entry = self.info["features"].get(feature)
        if entry is None:
            return []
        names, count = entry.get("names"), math.prod(map(int, entry["shape"]))
        if not 0 < count <= MOST_NUMBERS:
            shape = str(entry["shape"])[:80]
            raise CheckpointError(
                f"{self.folder / INFO}: {feature} is of shape {shape}, at most {MOST_NUMBERS} numbers are read"
            )
        if isinstance(names, dict):
            names = next(iter(names.values()), None)
        if not isinstance(names, list) or len(names) != count or len(set(names)) != count:
            return [f"{prefix}_{i}" for i in range(count)]
        return [str(name) for name in names]

    def path(self, episode: Row, columns: str, form: str) -> Path:
        indices = {f"{x}_index": int(episode[f"{columns}/{x}_index"]) for x in ("chunk", "file")}
        return self.folder / form.format(video_key=self.key, **indices)

    def data_path(self, episode: Row) -> Path:
        return self.path(episode, "data", self.info.get("data_path") or DATA)

    def frames(self, episode: Row, table: pa.Table) -> Iterator[np.ndarray]:
        """Yield the T images (height, width, 3) uint8 of one episode. `table` holds the episode's T rows."""
        if self.info["features"][self.key]["dtype"] == "image":
            return _pictures(table[self.key], self.folder, self.data_path(episode))
        path = self.path(episode, f"videos/{self.key}", self.info.get("video_path") or VIDEO)
        start = float(episode[f"videos/{self.key}/from_timestamp"])
        return _video_frames(path, start, float(self.info["fps"]), len(table))


def import_lerobot(settings: DemosImportSettings, folder: Path, progress: OnProgress) -> DemoDataset:
    if folder.exists():
        raise UsageError(f"{folder} exists: give the new demonstrations another name")
    path = Path(settings.source).expanduser()
    with _reading(path):
        source = Source.open(path, settings.camera)
        write_folder(folder, lambda new: _import(source, settings, new, progress))
    return DemoDataset.open(folder)


def _import(source: Source, settings: DemosImportSettings, folder: Path, progress: OnProgress) -> None:
    world = _world_of(source, settings)
    names = _task_names(source.tasks, world)
    environment = world.name if world else settings.name or source.folder.name
    if world is None:
        check_recorded(environment)
    chosen = source.episodes[: settings.episodes or None]
    entries, of_files = dict[str, list[EpisodeEntry]](), dict[Path, list[Row]]()
    limits, state, done = list[np.ndarray](), 0, 0
    for row in chosen:
        of_files.setdefault(source.data_path(row), []).append(row)
    for path, rows in of_files.items():
        table = _table(path, ["episode_index", "task_index", *VECTORS, source.key])
        for row in rows:
            with _reading(path):
                episode = _episode(source, row, path, table, names, settings.tail)
                entry = EpisodeEntry.saved(folder, episode, level=1)  # other levels take minutes for large images
            entries.setdefault(episode.task, []).append(entry)
            limits += [episode.executed.min(0), episode.executed.max(0)]
            state, done = episode.states.shape[1], done + 1
            progress(done, len(chosen))
    if world:
        space, instructions = world.actions, {}
        observation = _observation(source, state, world)
    else:
        space = action_space(source, settings, np.array(limits))
        observation = ObservationSpace(tuple(source.names(STATE, "state")[:state]), state, (), (0.0, 0.0, 0.0))
        instructions = {names[i]: text for i, text in source.tasks.items() if names[i] in entries}
    manifest = {
        "format": FORMAT,
        "environment": environment,
        "config": {
            "source": str(source.folder.resolve()),
            "camera": {"name": source.camera},
            "frame_stride": 1,
            "tail": settings.tail,
            "tasks": list(entries),
        },
        "actions": space.as_dict(),
        "observation": asdict(observation),
        "versions": {"lerobot": str(source.info["codebase_version"])},
        **totals(entries, {}, missing=0),
        "instructions": instructions,
    }
    write_json(folder / "recording.json", {key: manifest[key] for key in ("format", "environment", "config")})
    write_json(folder / "manifest.json", manifest)


def _world_of(source: Source, settings: DemosImportSettings) -> EnvironmentSpec | None:
    if not settings.environment:
        return None
    spec: EnvironmentSpec = EnvironmentPart.find(settings.environment).built()
    spec.camera_name(source.camera)
    ours, theirs = (spec.actions.dofs, spec.actions.control_hz), (len(source.names(ACTION)), source.info["fps"])
    if ours != theirs:
        raise UsageError(
            f"environment={spec.name}: it has {ours[0]} DoFs and {ours[1]:g} control steps per second, the dataset "
            f"{theirs[0]} and {theirs[1]:g}"
        )
    return spec


def _observation(source: Source, state: int, world: EnvironmentSpec) -> ObservationSpace:
    whole, alone = world.observation, world.observation.without_state()
    if state in (whole.state, alone.state):
        return whole if state == whole.state else alone
    raise CheckpointError(
        f"{source.folder} has {state} numbers of state, {world.name} has {alone.state} of proprioception "
        f"({STATE}) and {whole.state} in all ({ENVIRONMENT})"
    )


def _episode(source: Source, row: Row, path: Path, table: pa.Table, names: Mapping[int, str], tail: int) -> DemoEpisode:
    number, length = int(row["episode_index"]), int(row["length"])
    table = table.filter(pc.equal(table["episode_index"], number))
    if not 0 < len(table) == length:
        raise CheckpointError(f"{path} has {len(table)} rows of episode {number}, not its length")
    columns = {name: _vectors(table, name) for name in VECTORS if name in table.column_names}
    for name, values in columns.items():
        if name in source.info["features"] and values.shape[1] != len(source.names(name)):
            raise CheckpointError(f"{path}: {name} has {values.shape[1]} numbers per row, not those of {INFO}")
        if not np.isfinite(values).all():
            raise CheckpointError(f"{path}: episode {number} holds numbers that are not finite")
    labels = columns[ACTION]
    states = columns.get(ENVIRONMENT, columns.get(STATE, np.zeros((length, 0), np.float32)))
    frames: Any = source.frames(row, table)
    return DemoEpisode(
        task=names[int(table["task_index"][0].as_py())],
        seed=number,
        perturbed=False,
        steps=length,
        frames=frames,
        frame_steps=np.arange(length, dtype=np.int64),
        states=states,
        labels=np.concatenate([labels, np.repeat(labels[-1:], tail, 0)]),
        executed=columns.get(EXECUTED, labels),
        initial_state=states[0].astype(np.float64),
    )


def action_space(source: Source, settings: DemosImportSettings, actions: np.ndarray) -> ActionSpace:
    """Return the action space of a dataset. Its limits are the smallest and largest values in `actions` (n, D)."""
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
    if len(names) == 7 and tuple(strict) == tuple(names[-1:]):
        return Group("position", 3), Group("rotation", 3), Group("gripper", 1)
    groups, sorts = [], {True: "strict", False: "motion"}
    for number, (is_strict, run) in enumerate(itertools.groupby(names, lambda name: name in strict)):
        groups.append(Group(f"{sorts[is_strict]}_{number}", len(list(run))))
    return tuple(groups)


def _task_names(tasks: Mapping[int, str], world: EnvironmentSpec | None) -> dict[int, str]:
    if world:
        known = {task.instruction: task.name for task in reversed([*world.tasks.values()])}  # the first of equals
        for text in tasks.values():
            if text not in known:
                raise UsageError(f"environment={world.name}: it has no task with the instruction '{text}'")
        return {number: known[text] for number, text in tasks.items()}
    names, taken = dict[int, str](), set[str]()
    for number, text in tasks.items():
        name = imported_name(text) or f"task-{number}"
        names[number] = name if name not in taken else f"{name}-{number}"
        taken.add(names[number])
    return names


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        name = "" if isinstance(error, OSError | ValueError) else f"{type(error).__name__} "
        why = " ".join(str(error).replace(str(path), "it").split())[:120]
        raise CheckpointError(f"{path} is missing, damaged or not as LeRobot writes it: {name}{why}") from error


def _table(path: Path, columns: Sequence[str]) -> pa.Table:
    with _reading(path):
        return foreign_table(path, columns)


def _vectors(table: pa.Table, name: str) -> np.ndarray:
    # (T, n) float32; the rows of a column may be lists of lists
    part, rows = table[name].combine_chunks(), len(table)
    while pa.types.is_nested(part.type):
        lengths = pc.unique(pc.list_value_length(part)).to_pylist()
        if len(lengths) > 1 or None in lengths:
            raise ValueError(f"the rows of {name} have different lengths")
        part = part.flatten()
    return part.to_numpy(zero_copy_only=False).astype(np.float32).reshape(rows, -1)


def _pictures(cells: pa.ChunkedArray, folder: Path, path: Path) -> Iterator[np.ndarray]:
    # a cell holds the image's bytes or its path below `folder`
    for cell in cells:
        value = cell.as_py()
        data = value.get("bytes")
        place = path if data else folder / str(value.get("path"))
        with _reading(place), Image.open(io.BytesIO(data) if data else place) as image:
            yield np.asarray(image.convert("RGB"))


def _video_frames(path: Path, start: float, rate: float, count: int) -> Iterator[np.ndarray]:
    # the frames nearest to the times start, start + 1 / rate, … in seconds
    try:
        import av
    except ImportError as error:
        raise KervError("datasets with videos need the package av: pip install 'kerv[lerobot]'") from error
    done, half = 0, 0.5 / rate
    with _reading(path):
        try:
            with av.open(str(path)) as container:
                stream = container.streams.video[0]
                if start > 0:
                    container.seek(int(start / float(stream.time_base)), stream=stream)
                for frame in container.decode(stream):
                    while done < count and float(frame.time) >= start + done / rate - half:
                        yield frame.to_ndarray(format="rgb24")
                        done += 1
                    if done == count:
                        return
        except av.error.FFmpegError as error:
            raise ValueError(str(error)) from error
    raise CheckpointError(f"{path} ends {count - done} frames before its episode does")
