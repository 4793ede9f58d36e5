"""A recorded set of demonstrations on disk, checked and read back."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_mapping, sha256_of
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import add
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.worlds import stands_for_tasks
from kerv_cli.worlds.demos.episode_file import DemoEpisode, load_episode
from kerv_cli.worlds.demos.frames import EncodedFrames
from kerv_cli.worlds.spec import EnvironmentSpec
from kerv_cli.worlds.task import Task

OnProgress = Callable[[int, int], object]
"""Called with (done, total) after every episode or batch of a long work."""

FORMAT = 2
"""Format of manifests."""

SPECS = SimpleNamespace()
"""Specifications of recorded environments, as attributes."""


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode in the manifest.

    Attributes:
        seed: Seed of the episode.
        perturbed: Whether its execution was noisy.
        steps: Control steps up to the success.
        bytes: Size of its file.
        sha256: Hash of its file.
    """

    seed: int
    perturbed: bool
    steps: int
    bytes: int
    sha256: str

    @classmethod
    def of(cls, path: Path, episode: DemoEpisode) -> EpisodeEntry:
        """Describe an episode that was saved to `path`."""
        return cls(episode.seed, episode.perturbed, episode.steps, path.stat().st_size, sha256_of(path))


@dataclass(frozen=True)
class TaskEntry:
    """The episodes of one task, by seed."""

    episodes: tuple[EpisodeEntry, ...]
    mean_steps: float = 0.0
    failed_seeds: tuple[int, ...] = ()


@dataclass(frozen=True)
class DemoManifest:
    """The manifest of a dataset.

    Attributes:
        format: Format of the manifest.
        environment: Name of the tasks' environment.
        actions: Its action space.
        observation: Its observation space.
        config: Fields of `DemoConfig` without the workers.
        tasks: Episodes of each task.
        sha256: Hash over the hashes of all episode files.
        versions: Versions of the packages that physics and frames depend on.
        seeds: The first and the last seed.
        episodes: Number of episodes.
        missing: Number of requested episodes that failed.
        instructions: Task to instruction, for recorded data whose tasks no registered environment has.
    """

    format: int
    environment: str
    actions: ActionSpace
    observation: ObservationSpace
    config: dict[str, Any]
    tasks: dict[str, TaskEntry]
    sha256: str
    versions: dict[str, str] = field(default_factory=dict)
    seeds: dict[str, int] = field(default_factory=dict)
    episodes: int = 0
    missing: int = 0
    instructions: dict[str, str] = field(default_factory=dict)


def register_recorded(
    name: str, actions: ActionSpace, observation: ObservationSpace, instructions: Mapping[str, str], camera: str
) -> EnvironmentSpec:
    """Register the environment of a dataset that exists only as a recording: nothing can be rolled out in it.

    Args:
        name: An identifier. In capitals it is the suite of all tasks.
        actions: Action space.
        observation: Observation space.
        instructions: Task to instruction.
        camera: Name of the recorded view.
    """
    tasks = {task: Task(task, instruction, "recorded") for task, instruction in instructions.items()}
    suites = {name.upper(): tuple(tasks)}
    spec = EnvironmentSpec(name, actions, observation, tasks, suites, ("recorded",), 10_000, (camera,))
    setattr(SPECS, name, spec)
    add("environment", name, f"{__name__}:SPECS.{name}")
    return spec


def episode_path(folder: Path, task: str, seed: int) -> Path:
    """Return the file of an episode within the dataset's folder."""
    return folder / "episodes" / task / f"{seed:06d}.safetensors"


def dataset_hash(tasks: Mapping[str, Any]) -> str:
    """Return a SHA-256 over the hashes of the episode files. `tasks` is that of a manifest's JSON."""
    digest = hashlib.sha256()
    for task, summary in sorted(tasks.items()):
        for episode in summary["episodes"]:
            digest.update(f"{task} {episode['seed']} {episode['sha256']}\n".encode())
    return digest.hexdigest()


def totals(
    entries: Mapping[str, Sequence[EpisodeEntry]], failed: Mapping[str, Sequence[int]], missing: int
) -> dict[str, Any]:
    """Return the manifest's fields that sum up its episodes, as JSON.

    Args:
        entries: Episodes of each task.
        failed: Task to the seeds that failed.
        missing: Number of requested episodes that failed.
    """
    tasks = {}
    for task, rows in entries.items():
        episodes = [asdict(entry) for entry in sorted(rows, key=lambda entry: entry.seed)]
        mean = round(sum(entry.steps for entry in rows) / len(rows), 2)
        tasks[task] = {"mean_steps": mean, "failed_seeds": sorted(failed.get(task, ())), "episodes": episodes}
    seeds = [entry.seed for rows in entries.values() for entry in rows]
    return {
        "seeds": {"first": min(seeds), "last": max(seeds)},
        "episodes": len(seeds),
        "missing": missing,
        "sha256": dataset_hash(tasks),
        "tasks": tasks,
    }


@dataclass(frozen=True)
class DemoEntry(EpisodeEntry):
    """An episode of a dataset, and its file."""

    task: str
    path: Path


@dataclass(frozen=True)
class DemoDataset:
    """A complete recording on disk.

    Attributes:
        path: The dataset's folder.
        manifest: What was recorded.
        episodes: One entry per episode, by task in the recording's order, then by seed.
        views: Number of recorded views to read, from the left. 0 means all.
    """

    path: Path
    manifest: DemoManifest
    episodes: list[DemoEntry]
    views: int = 0

    @property
    def sha256(self) -> str:
        """Hash over the hashes of all episode files. Two datasets with the same hash are the same."""
        return self.manifest.sha256

    @classmethod
    def open(cls, path: Path) -> DemoDataset:
        """Open a dataset. Checks that its files are there in full size; `load` checks their contents.

        Raises:
            CheckpointError: There is no dataset, its recording was not finished, or it is damaged.
        """
        file = path / "manifest.json"
        if not file.exists():
            command = f"'kerv demos {'task' if stands_for_tasks(path.name) else 'name'}={path.name}'"
            if (path / "recording.json").exists():
                raise CheckpointError(f"the demonstrations in {path} are unfinished: run {command} again to go on")
            raise CheckpointError(f"no demonstrations in {path}: record them with {command}")
        value = read_mapping(file)
        if value.get("format") != FORMAT:
            raise CheckpointError(f"{file} has format {value.get('format')}, this kerv reads {FORMAT}")
        manifest = read(DemoManifest, value, str(file))
        if manifest.sha256 != dataset_hash(value["tasks"]):
            raise CheckpointError(f"{file} is damaged: its hash does not fit its episodes")
        if manifest.instructions:
            camera, spaces = manifest.config["camera"]["name"], (manifest.actions, manifest.observation)
            register_recorded(manifest.environment, *spaces, manifest.instructions, camera)
        entries = [
            DemoEntry(**asdict(entry), task=task, path=episode_path(path, task, entry.seed))
            for task, summary in manifest.tasks.items()
            for entry in summary.episodes
        ]
        for entry in entries:
            if not entry.path.is_file() or entry.path.stat().st_size != entry.bytes:
                raise CheckpointError(f"{entry.path} is missing or cut short: run 'kerv demos' again to restore it")
        return cls(path, manifest, entries)

    @classmethod
    def joined(cls, parts: Sequence[DemoDataset]) -> DemoDataset:
        """Return all episodes of `parts`, in order. The manifest is the first one's, with the tasks and hash of all.

        Raises:
            CheckpointError: They are of different environments or cameras.
        """
        if len(parts) == 1:
            return parts[0]
        first = parts[0].manifest
        for part in parts[1:]:
            other = part.manifest
            for what, ours, theirs in (
                ("environment", first.environment, other.environment),
                ("action space", first.actions, other.actions),
                ("observation space", first.observation, other.observation),
                ("camera", first.config["camera"], other.config["camera"]),
            ):
                if ours != theirs:
                    raise CheckpointError(f"{part.path} has another {what} than {parts[0].path}: they cannot be joined")
        combined = hashlib.sha256("\n".join(part.sha256 for part in parts).encode()).hexdigest()
        config = {**first.config, "joined": [part.manifest.config for part in parts[1:]]}
        episodes = [entry for part in parts for entry in part.episodes]
        tasks = {name: entry for part in reversed(parts) for name, entry in part.manifest.tasks.items()}
        return cls(parts[0].path, replace(first, sha256=combined, config=config, tasks=tasks), episodes)

    def load(self, index: int) -> DemoEpisode:
        """Read the episode of entry `index` of `episodes`.

        Raises:
            CheckpointError: The file changed since it was recorded.
        """
        entry = self.episodes[index]
        if sha256_of(entry.path) != entry.sha256:
            raise CheckpointError(
                f"{entry.path} changed since it was recorded: move it aside and run 'kerv demos' again"
            )
        episode = load_episode(entry.path)
        frames = episode.frames
        if not self.views or not isinstance(frames, EncodedFrames):
            return episode
        return replace(episode, frames=frames.left(self.views * frames.size))
