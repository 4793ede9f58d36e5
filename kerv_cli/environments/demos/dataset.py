"""A recorded set of demonstrations on disk, checked and read back."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kerv_cli.environments.demos.episode_file import FORMAT, DemoEpisode, load_episode
from kerv_cli.environments.metaworld.spec import ACTIONS, OBSERVATION
from kerv_cli.errors import CheckpointError
from kerv_cli.files import read_json, sha256_of
from kerv_cli.spaces import ActionSpace, ObservationSpace


def episode_path(out: Path, task: str, seed: int) -> Path:
    """Where an episode lies within a dataset's folder."""
    return Path(out) / "episodes" / task / f"{seed:06d}.safetensors"


def dataset_hash(tasks: Mapping[str, Any]) -> str:
    """Hex hash over the episode files' hashes, for a manifest's `tasks`."""
    digest = hashlib.sha256()
    for task, summary in sorted(tasks.items()):
        for episode in summary["episodes"]:
            digest.update(f"{task} {episode['seed']} {episode['sha256']}\n".encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class DemoEntry:
    """What the manifest tells of one episode; `steps` are control steps up to the success, `sha256` is the file's."""

    task: str
    seed: int
    perturbed: bool
    steps: int
    path: Path
    bytes: int
    sha256: str


@dataclass(frozen=True)
class DemoDataset:
    """A complete recording on disk.

    Attributes:
        path: the dataset's folder.
        manifest: as `record` returned it.
        episodes: one entry per episode, by task in the recording's order, then by seed.
    """

    path: Path
    manifest: dict[str, Any]
    episodes: list[DemoEntry]

    @property
    def sha256(self) -> str:
        """Hex hash over the hashes of all episode files: two datasets with the same hash are the same."""
        return str(self.manifest["sha256"])

    @property
    def environment(self) -> str:
        """Name of the environment it was recorded in; what was recorded before there was more than one has none."""
        return str(self.manifest.get("environment", "metaworld"))

    @property
    def actions(self) -> ActionSpace:
        """Its environment's action space."""
        return ACTIONS

    @property
    def observation(self) -> ObservationSpace:
        """Its environment's observation space."""
        return OBSERVATION

    @classmethod
    def open(cls, path: Path) -> DemoDataset:
        """Opens a dataset and checks that its episode files are there in full size; contents are checked by `load`.

        Raises:
            CheckpointError: no dataset there, its recording was not finished, or it is damaged.
        """
        path = Path(path)
        if not (path / "manifest.json").exists():
            if (path / "recording.json").exists():
                raise CheckpointError(f"the demonstrations in {path} are unfinished: run 'kerv demos' again to go on")
            raise CheckpointError(f"no demonstrations in {path}: record them with 'kerv demos'")
        manifest = read_json(path / "manifest.json")
        try:
            if manifest["format"] != FORMAT:
                raise CheckpointError(f"{path} has format {manifest['format']}, this kerv reads {FORMAT}")
            entries = [
                DemoEntry(task, path=episode_path(path, task, entry["seed"]), **entry)
                for task, summary in manifest["tasks"].items()
                for entry in summary["episodes"]
            ]
            intact = manifest["sha256"] == dataset_hash(manifest["tasks"])
        except (KeyError, TypeError, AttributeError) as error:
            raise CheckpointError(f"{path / 'manifest.json'} is damaged: {error}") from error
        if not intact:
            raise CheckpointError(f"{path / 'manifest.json'} is damaged: its hash does not fit its episodes")
        for entry in entries:
            if not entry.path.is_file() or entry.path.stat().st_size != entry.bytes:
                raise CheckpointError(f"{entry.path} is missing or cut short: run 'kerv demos' again to restore it")
        return cls(path, manifest, entries)

    def load(self, index: int) -> DemoEpisode:
        """Reads episode `index` of `episodes`.

        Raises:
            CheckpointError: the file changed since it was recorded.
        """
        entry = self.episodes[index]
        if sha256_of(entry.path) != entry.sha256:
            raise CheckpointError(f"{entry.path} changed since it was recorded: delete it and run 'kerv demos' again")
        return load_episode(entry.path)
