"""Read a recorded set of demonstrations from disk and check it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import read_mapping, sha256_of
from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.worlds import EnvironmentPart, Task
from kerv_cli.worlds.demos.files import DemoEpisode, EncodedFrames, load_episode, save_episode
from kerv_cli.worlds.spec import EnvironmentSpec

OnProgress = Callable[[int, int], object]  # called with (done, total) after every episode or batch

FORMAT = 2  # of the manifest


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode in the manifest of a dataset. `bytes` is the size of its file, `sha256` the file's hash."""

    seed: int
    # whether noise was added to the executed actions, or an actor moved the robot instead of the expert
    perturbed: bool
    steps: int  # number of control steps, up to the success
    bytes: int
    sha256: str

    @classmethod
    def saved(cls, folder: Path, episode: DemoEpisode, level: int = 6) -> EpisodeEntry:
        path = episode_path(folder, episode.task, episode.seed)
        save_episode(path, episode, level)
        return cls.of(path, episode)

    @classmethod
    def of(cls, path: Path, episode: DemoEpisode) -> EpisodeEntry:
        return cls(episode.seed, episode.perturbed, episode.steps, path.stat().st_size, sha256_of(path))


@dataclass(frozen=True)
class TaskEntry:
    """The episodes of one task in a manifest, sorted by seed. The expert did not succeed with the `failed_seeds`."""

    episodes: tuple[EpisodeEntry, ...]
    mean_steps: float = 0.0
    failed_seeds: tuple[int, ...] = ()


@dataclass(frozen=True)
class DemoManifest:
    """The manifest of a dataset: what was recorded (docs/formats.md)."""

    format: int
    environment: str
    actions: ActionSpace
    observation: ObservationSpace
    config: dict[str, Any]  # fields of `DemoConfig` without `workers`
    tasks: dict[str, TaskEntry]
    sha256: str  # hash over the hashes of all episode files
    # versions of the packages on which physics and images depend
    versions: dict[str, str] = field(default_factory=dict)
    # the smallest and the largest seed, with the keys `first` and `last`
    seeds: dict[str, int] = field(default_factory=dict)
    episodes: int = 0
    missing: int = 0  # number of requested episodes that could not be recorded because experts failed
    # the instruction of each task. Only for imported data, whose tasks belong to no registered environment.
    instructions: dict[str, str] = field(default_factory=dict)


def _facts(manifest: DemoManifest) -> dict[str, Any]:
    # must be equal in all datasets that are joined
    spaces = {"action space": manifest.actions, "observation space": manifest.observation}
    return {"environment": manifest.environment, **spaces, "camera": manifest.config["camera"]}


def register_recorded(
    name: str, actions: ActionSpace, observation: ObservationSpace, instructions: Mapping[str, str], camera: str
) -> EnvironmentSpec:
    """Register an environment for imported data. No episode can run in it.

    All tasks form a suite. The suite's name is the environment's name in capitals.
    """
    tasks = {task: Task(task, instruction) for task, instruction in instructions.items()}
    suites = {name.upper(): tuple(tasks)}
    spec = EnvironmentSpec(name, actions, observation, tasks, suites, 10_000, (camera,))
    EnvironmentPart(name)(lambda: spec)
    return spec


def check_recorded(name: str) -> None:
    part = EnvironmentPart.every().get(name)
    if part is not None and part.module != __name__:
        raise UsageError(
            f"'{name}' is an environment of kerv: choose another name=, or set environment={name} if the data were "
            "recorded in it"
        )


def episode_path(folder: Path, task: str, seed: int) -> Path:
    return folder / "episodes" / task / f"{seed:06d}.safetensors"


def dataset_hash(tasks: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a text with a line per episode: its task, its seed and the hash of its file."""
    digest = hashlib.sha256()
    for task, summary in sorted(tasks.items()):
        for episode in summary["episodes"]:
            digest.update(f"{task} {episode['seed']} {episode['sha256']}\n".encode())
    return digest.hexdigest()


def totals(
    entries: Mapping[str, Sequence[EpisodeEntry]], failed: Mapping[str, Sequence[int]], missing: int
) -> dict[str, Any]:
    tasks, seeds = {}, []
    for task, rows in entries.items():
        seeds += [entry.seed for entry in rows]
        episodes = [asdict(entry) for entry in sorted(rows, key=attrgetter("seed"))]
        mean = round(sum(entry.steps for entry in rows) / len(rows), 2)
        tasks[task] = {"mean_steps": mean, "failed_seeds": sorted(failed.get(task, ())), "episodes": episodes}
    return {
        "seeds": {"first": min(seeds), "last": max(seeds)},
        "episodes": len(seeds),
        "missing": missing,
        "sha256": dataset_hash(tasks),
        "tasks": tasks,
    }


@dataclass(frozen=True)
class DemoEntry(EpisodeEntry):
    """An episode of a dataset on disk."""

    task: str
    path: Path


@dataclass(frozen=True)
class DemoDataset:
    """A complete set of recorded demonstrations on disk."""

    path: Path
    manifest: DemoManifest
    # one entry per episode, sorted by dataset if several were joined, then by task, then by seed
    episodes: list[DemoEntry]
    # if images show several views side by side, read only this number of them, from the left. If 0, read all.
    views: int = 0

    @property
    def sha256(self) -> str:
        return self.manifest.sha256

    @classmethod
    def open(cls, path: Path) -> DemoDataset:
        """Open a dataset, and check that all files exist and have their full size. `load` checks their contents."""
        file = path / "manifest.json"
        if not file.exists():
            raise CheckpointError(f"{file} is missing: the recording of these demonstrations is unfinished")
        value = read_mapping(file)
        if value.get("format") != FORMAT:
            raise CheckpointError(f"{file} has format {value.get('format')}, this kerv reads {FORMAT}")
        manifest = read(DemoManifest, value, str(file))
        if manifest.sha256 != dataset_hash(value["tasks"]):
            raise CheckpointError(f"{file} is damaged: its hash does not match its episodes")
        if manifest.instructions:
            camera, spaces = manifest.config["camera"]["name"], (manifest.actions, manifest.observation)
            register_recorded(manifest.environment, *spaces, manifest.instructions, camera)
        entries = []
        for task, summary in manifest.tasks.items():
            for entry in summary.episodes:
                file = episode_path(path, task, entry.seed)
                if not file.is_file() or file.stat().st_size != entry.bytes:
                    raise CheckpointError(f"{file} is missing or cut short: run 'kerv demos' again to restore it")
                entries.append(DemoEntry(**asdict(entry), task=task, path=file))
        return cls(path, manifest, entries)

    @classmethod
    def joined(cls, parts: Sequence[DemoDataset]) -> DemoDataset:
        """Join datasets under the first one's manifest, with the tasks of all datasets and a hash over their hashes."""
        if len(parts) == 1:
            return parts[0]
        first, ours = parts[0].manifest, _facts(parts[0].manifest)
        for part in parts[1:]:
            for what, value in _facts(part.manifest).items():
                if value != ours[what]:
                    raise CheckpointError(f"{part.path} has another {what} than {parts[0].path}: they cannot be joined")
        combined = hashlib.sha256("\n".join(part.sha256 for part in parts).encode()).hexdigest()
        config = {**first.config, "joined": [part.manifest.config for part in parts[1:]]}
        episodes, tasks = list[DemoEntry](), dict[str, TaskEntry]()
        for part in parts:
            episodes += part.episodes
            tasks = part.manifest.tasks | tasks
        return cls(parts[0].path, replace(first, sha256=combined, config=config, tasks=tasks), episodes)

    def of_tasks(self, *tasks: str) -> list[int]:
        return [index for index, entry in enumerate(self.episodes) if entry.task in tasks]

    def load(self, index: int) -> DemoEpisode:
        entry, path = self.episodes[index], self.episodes[index].path
        if sha256_of(path) != entry.sha256:
            raise CheckpointError(f"{path} changed since it was recorded: move it aside and run 'kerv demos' again")
        episode = load_episode(path)
        frames = episode.frames
        if not self.views or not isinstance(frames, EncodedFrames):
            return episode
        frames = EncodedFrames(frames.files, frames.spans, frames.size, self.views * frames.size)  # the first views
        return replace(episode, frames=frames)
