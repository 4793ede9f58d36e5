"""`kerv build datastore`: store demonstrated chunks, keyed by encoded observations (docs/methods.md §4.1)."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import read_mapping, sha256_of, visible, write_folder, write_json
from kerv_cli.base.runtime import set_up
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.heisd.datastore import (
    PAYLOAD,
    PROJECTION,
    VECTORS,
    Datastore,
    Manifest,
    Shard,
    check_seeds,
    projected,
    prompt_key,
)
from kerv_cli.targets.folders import check_not_shipped
from kerv_cli.targets.observations import observations_of, prompts_of, read_chunks, steps_of
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.settings import BuildDatastoreSettings
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import OnProgress
from kerv_cli.worlds.demos.files import DemoEpisode

BATCH = 128
"""Maximum number of observations that are encoded together."""


class DatastoreBuild:
    """One datastore to build. The constructor checks that it is possible, and `build` writes the datastore.

    Raises:
        CheckpointError: The target or the demonstrations do not exist. Or the demonstrations are of another
            environment, contain evaluation seeds, or have no episode of a task.
        UsageError: `key` is empty. Or the folder holds something else than a datastore.
    """

    def __init__(self, settings: BuildDatastoreSettings) -> None:
        self.settings, self.dataset = demos_for(settings)
        settings = self.settings
        tasks = sorted(resolve_tasks(settings.task or list(self.dataset.manifest.tasks)))
        self.device, _ = set_up(settings.runtime)
        self.artifacts = Artifacts(settings.results, settings.policy, device=self.device, dtype=settings.runtime.dtype)
        if not settings.key:
            raise UsageError("key=[]: name at least one part of the prompt: scene, vision, proprioception")
        self.folder = self.artifacts.new("datastore")
        check_not_shipped(self.folder, "policy.artifacts.datastore")
        entries, most = self.dataset.episodes, settings.episodes or None
        by_seed = sorted(range(len(entries)), key=lambda i: entries[i].seed)
        self.chosen = {name: [i for i in by_seed if entries[i].task == name][:most] for name in tasks}
        self.seeds = {name: [entries[i].seed for i in chosen] for name, chosen in self.chosen.items()}
        check_seeds(self.seeds, self.dataset.path)
        manifest = self.folder / "manifest.json"
        kind = read_mapping(manifest).get("kind") if manifest.is_file() else None
        if kind != "datastore" and (self.folder.is_file() or visible(self.folder)):
            raise UsageError(f"{self.folder} exists and is no datastore: give the new one another name")

    def plan(self) -> str:
        """Return one line that `--plan` prints: episodes, tasks, target and folder."""
        episodes = [self.dataset.episodes[i] for chosen in self.chosen.values() for i in chosen]
        return (
            f"{self.folder}: {count(len(episodes), 'demonstration')} of {count(len(self.chosen), 'task')}, "
            f"{sum(episode.steps for episode in episodes)} control steps, through {self.artifacts.folder}, keys from "
            f"{' + '.join(self.settings.key)}"
        )

    def build(self, progress: OnProgress = lambda done, total: None) -> Datastore:
        """Write the datastore and open it. An older datastore in the same folder is replaced at the end.

        Args:
            progress: Called with the numbers of episodes done and of all.

        Raises:
            CheckpointError: An episode has too few actions of the expert, or images of another size than the target
                takes.
            UnknownName: `key` names an unknown part of the prompt.
            StorageError: The disk cannot be written.
        """
        parts: list[dict[str, np.ndarray]] = []
        shards: dict[str, Shard] = {}
        rows = 0
        for name, chosen in self.chosen.items():
            first = rows
            for index in chosen:
                parts.append(self._entries(self.dataset.load(index)))
                rows += len(parts[-1]["step"])
                progress(len(parts), sum(map(len, self.chosen.values())))
            shards[name] = Shard((first, rows), tuple(self.seeds[name]))
        files = self._contents({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, shards)
        write_folder(self.folder, lambda folder: self._write(folder, files, shards))
        return Datastore.open(self.folder, self.artifacts.description)

    @torch.inference_mode()
    def _entries(self, episode: DemoEpisode) -> dict[str, np.ndarray]:
        """Make the entries of an episode: one for every observation.

        Returns:
            The values of each column, one row per entry. The column `keys` holds the encoded observations, and `tokens`
            the expert's next H undisturbed actions.
        """
        target: Any = self.artifacts.target
        steps = steps_of(episode, bool(target.cameras))
        tokens = target.actions.encode(read_chunks(episode, steps, target.chunk)).reshape(len(steps), -1)
        observations = observations_of(target, episode, steps, self.dataset.manifest.observation)
        size = -(-len(steps) // -(-len(steps) // BATCH))  # equal batches
        prompts = prompts_of(target, observations, size)
        keys = [prompt_key(prompt, target, self.settings.key).cpu().numpy() for prompt in prompts]
        return {
            "seed": np.full(len(steps), episode.seed),
            "step": steps.astype(np.int64),  # control steps since the start
            "left": episode.steps - steps,  # control steps until the success
            "tokens": tokens.astype(np.uint8),
            "keys": np.concatenate(keys),
        }

    def _contents(self, columns: dict[str, np.ndarray], shards: Mapping[str, Shard]) -> dict[str, Any]:
        """Return the files to write: an array or table by file name.

        Args:
            columns: The values of each column, one row per entry of all tasks.
            shards: For each task the range of its rows, and the seeds of its episodes.
        """
        keys, tokens, files = columns.pop("keys"), columns.pop("tokens"), {}
        if self.settings.components:
            # the orthonormal directions that keep most of the keys' squared length
            values, vectors = np.linalg.eigh(keys.T.astype(np.float64) @ keys)
            files[PROJECTION] = vectors[:, np.argsort(-values)[: self.settings.components]].astype(np.float32)
            keys = projected(keys, files[PROJECTION])
        files[VECTORS] = keys.astype(np.float16 if self.settings.half else np.float32)
        counts = [shard.rows[1] - shard.rows[0] for shard in shards.values()]
        task = np.repeat(np.arange(len(shards), dtype=np.int32), counts)
        table = {
            "task": pa.DictionaryArray.from_arrays(task, [*shards]),
            **columns,
            "tokens": pa.FixedSizeListArray.from_arrays(pa.array(tokens.ravel()), tokens.shape[1]),
        }
        return {**files, PAYLOAD: pa.table(table)}

    def _write(self, folder: Path, files: Mapping[str, Any], shards: dict[str, Shard]) -> None:
        for name, content in files.items():
            # write to memory first: on a full disk, numpy and pyarrow raise errors without an errno
            buffer = io.BytesIO()
            if name == PAYLOAD:
                pq.write_table(content, buffer, compression="zstd")
            else:
                np.save(buffer, content)
            (folder / name).write_bytes(buffer.getbuffer())
        target = self.artifacts.description
        manifest = Manifest(
            format=2,
            kind="datastore",
            key=tuple(self.settings.key),
            width=files[VECTORS].shape[1],
            rows=len(files[VECTORS]),
            chunk=target.chunk,
            actions=target.actions,
            target=target.sha256,
            demos=self.dataset.sha256,
            files={name: sha256_of(folder / name) for name in files},
            tasks=shards,
            provenance=provenance_of("kerv build datastore", self.settings, self.device),
        )
        write_json(folder / "manifest.json", asdict(manifest))
