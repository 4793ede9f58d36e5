"""`kerv build datastore`: store demonstrated chunks, keyed by encoded observations (docs/methods.md §4.1)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import sha256_of, write_folder, write_json
from kerv_cli.base.manifests import stamped
from kerv_cli.base.paths import check_free
from kerv_cli.base.runtime import set_up
from kerv_cli.base.spaces import ObservationSpace
from kerv_cli.engine.decoder import Stopwatch
from kerv_cli.lab.database import Database
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.heisd import datastore as stored
from kerv_cli.targets.observations import observations_of, observed_steps, prompts_of, read_chunks
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.settings import BuildDatastoreSettings, Plan, Stage
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.files import DemoEpisode

BATCH = 128  # maximum number of observations that are encoded together


@dataclass(frozen=True)
class DatastoreWork:
    """Builds a datastore, after `plan_datastore` has checked the settings."""

    settings: BuildDatastoreSettings
    artifacts: Artifacts
    dataset: DemoDataset
    chosen: dict[str, list[int]]  # episodes of each task, in the order of their seeds
    folder: Path

    def seeds(self, task: str) -> list[int]:
        return [self.dataset.episodes[index].seed for index in self.chosen[task]]

    def __call__(self, stage: Stage) -> tuple[Path, stored.Datastore]:
        parts: list[dict[str, np.ndarray]] = []
        shards: dict[str, stored.Shard] = {}
        rows, number = 0, sum(map(len, self.chosen.values()))
        with stage("encoding demonstrations") as progress:
            for task, indices in self.chosen.items():
                first = rows
                for index in indices:
                    episode, space = self.dataset.load(index), self.dataset.manifest.observation
                    parts.append(entries_of(self.artifacts.target, episode, space, self.settings.key))
                    rows += len(parts[-1]["step"])
                    progress(len(parts), number)
                shards[task] = stored.Shard((first, rows), tuple(self.seeds(task)))
        write_folder(self.folder, lambda new: self.write(new, parts, shards, rows))
        return self.folder, stored.Datastore.open(self.folder, self.artifacts.description)

    def seconds(self) -> float:
        """Estimate the seconds that all demonstrations take, from one of them."""
        first = next(iter(self.chosen.values()))[0]
        episode, space, times = self.dataset.load(first), self.dataset.manifest.observation, list[float]()
        for _ in range(2):  # the first time includes loading and compiling
            clock = Stopwatch(torch.device(self.artifacts.device))
            entries_of(self.artifacts.target, episode, space, self.settings.key)
            times.append(clock.stop())
        return min(times) * self.steps / episode.steps

    @property
    def steps(self) -> int:
        return sum(self.dataset.episodes[index].steps for indices in self.chosen.values() for index in indices)

    def write(
        self, new: Path, parts: Sequence[Mapping[str, np.ndarray]], shards: dict[str, stored.Shard], rows: int
    ) -> None:
        settings, target = self.settings, self.artifacts.description
        width = write_files(new, parts, settings)
        files = [name for name in (stored.PROJECTION, stored.VECTORS, stored.PAYLOAD) if (new / name).exists()]
        manifest = stored.Manifest(
            format=2,
            kind="datastore",
            key=tuple(settings.key),
            width=width,
            rows=rows,
            chunk=target.chunk,
            actions=target.actions,
            target=target.sha256,
            demos=self.dataset.sha256,
            files={name: sha256_of(new / name) for name in files},
            tasks=shards,
            provenance=provenance_of("kerv build datastore", settings, self.artifacts.device),
        )
        write_json(new / stored.MANIFEST, stamped(asdict(manifest)))


def plan_datastore(settings: BuildDatastoreSettings, database: Database) -> Plan[tuple[Path, stored.Datastore]]:
    """Check the settings of a datastore, and return the plan to build it from demonstrations.

    `Plan.make` returns the folder and the opened datastore.
    """
    if not settings.key:
        raise UsageError("key=[]: name at least one part of the prompt: scene, vision, proprioception")
    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, settings.policy, device=device, dtype=settings.runtime.dtype)
    settings, dataset = demos_for(settings, artifacts.description, database)
    folder = artifacts.new("datastore")
    check = partial(check_free, folder, "policy.artifacts.datastore", settings.replace)
    check()
    chosen = {}
    for task in sorted(resolve_tasks(settings.task or list(dataset.manifest.tasks))):
        by_seed = sorted(dataset.of_tasks(task), key=lambda index: dataset.episodes[index].seed)
        chosen[task] = by_seed[: settings.episodes or None]
    work = DatastoreWork(settings, artifacts, dataset, chosen, folder)
    stored.check_seeds({task: work.seeds(task) for task in chosen}, dataset.path)
    text = (
        f"{folder}: {count(sum(map(len, chosen.values())), 'demonstration')} of {count(len(chosen), 'task')}, "
        f"{work.steps} control steps, through {artifacts.folder}, keys from "
        f"{' + '.join(settings.key)}"
    )
    return Plan("datastore", folder, text, work, check, work.seconds)


@torch.inference_mode()
def entries_of(target: Any, episode: DemoEpisode, space: ObservationSpace, key: Sequence[str]) -> dict[str, np.ndarray]:
    steps = observed_steps(episode, bool(target.cameras))
    tokens = target.actions.chunk_tokens(read_chunks(episode, steps, target.chunk))
    observations = observations_of(target, episode, steps, space)
    size = -(-len(steps) // -(-len(steps) // BATCH))  # equal batches
    keys = [stored.prompt_key(prompt, target, key).cpu().numpy() for prompt in prompts_of(target, observations, size)]
    return {
        "task": np.full(len(steps), episode.task),
        "seed": np.full(len(steps), episode.seed),
        "step": steps.astype(np.int64),  # control steps since the start
        "left": episode.steps - steps,  # control steps until the success
        "tokens": tokens.astype(np.min_scalar_type(target.actions.tokens - 1)),
        "keys": np.concatenate(keys),
    }


def write_files(folder: Path, parts: Sequence[Mapping[str, np.ndarray]], settings: BuildDatastoreSettings) -> int:
    """Write the files of a datastore into a folder, except the manifest. Return the width of a key."""
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    keys, tokens, arrays = columns.pop("keys"), columns.pop("tokens"), {}
    if settings.components:
        # the orthonormal directions that keep most of the keys' squared length
        values, vectors = np.linalg.eigh(keys.T.astype(np.float64) @ keys)
        arrays[stored.PROJECTION] = vectors[:, np.argsort(-values)[: settings.components]].astype(np.float32)
        keys = stored.projected(keys, arrays[stored.PROJECTION])
    arrays[stored.VECTORS] = keys.astype(np.float16 if settings.half else np.float32)
    # write to memory first: on a full disk, numpy and pyarrow raise errors without an errno
    for name, array in arrays.items():
        buffer = io.BytesIO()
        np.save(buffer, array)
        (folder / name).write_bytes(buffer.getbuffer())
    table = {
        "task": pa.array(columns.pop("task")).dictionary_encode(),
        **columns,
        "tokens": pa.FixedSizeListArray.from_arrays(pa.array(tokens.ravel()), tokens.shape[1]),
    }
    buffer = io.BytesIO()
    pq.write_table(pa.table(table), buffer, compression="zstd")
    (folder / stored.PAYLOAD).write_bytes(buffer.getbuffer())
    return keys.shape[1]
