"""`kerv build datastore`: store demonstrated chunks, keyed by encoded observations (docs/methods.md §4.1)."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict
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
from kerv_cli.base.spaces import ObservationSpace
from kerv_cli.episodes.policy import artifacts_of
from kerv_cli.lab.database import Database
from kerv_cli.methods.heisd import datastore as stored
from kerv_cli.targets.observations import observations_of, prompts_of, read_chunks
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.targets.samples import observed_steps
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.fit import timed
from kerv_cli.training.settings import BuildDatastoreSettings, Plan, Stage
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.files import DemoEpisode

BATCH = 128  # maximum number of observations that are encoded together


def plan_datastore(settings: BuildDatastoreSettings, database: Database) -> Plan[tuple[Path, stored.Datastore]]:
    """Check the settings of a datastore, and return the plan to build it from demonstrations.

    `Plan.make` returns the folder and the opened datastore.
    """
    if not settings.key:
        raise UsageError("key=[]: name at least one part of the prompt: scene, vision, proprioception")
    artifacts = artifacts_of(settings)
    target, device = artifacts.description, artifacts.device
    settings, dataset = demos_for(settings, target, database)
    folder = artifacts.new("datastore")
    check = partial(check_free, folder, "policy.artifacts.datastore", settings.replace)
    chosen = {}
    for task in sorted(resolve_tasks(settings.task or list(dataset.manifest.tasks))):
        by_seed = sorted(dataset.of_tasks(task), key=lambda index: dataset.episodes[index].seed)
        chosen[task] = by_seed[: settings.episodes or None]
    seeds = {task: [dataset.episodes[index].seed for index in indices] for task, indices in chosen.items()}
    stored.check_seeds(seeds, dataset.path)
    every = list(itertools.chain(*chosen.values()))
    steps, space = sum(dataset.episodes[index].steps for index in every), dataset.manifest.observation
    text = (
        f"{folder}: {count(len(every), 'demonstration')} of {count(len(chosen), 'task')}, "
        f"{steps} control steps, through {artifacts.folder}, keys from "
        f"{' + '.join(settings.key)}"
    )

    def work(stage: Stage) -> tuple[Path, stored.Datastore]:
        parts: list[dict[str, np.ndarray]] = []
        shards: dict[str, stored.Shard] = {}
        rows = 0
        with stage("encoding demonstrations") as progress:
            for task, indices in chosen.items():
                first = rows
                for index in indices:
                    parts.append(entries_of(artifacts.target, dataset.load(index), space, settings.key))
                    rows += len(parts[-1]["step"])
                    progress(len(parts), len(every))
                shards[task] = stored.Shard((first, rows), tuple(seeds[task]))

        def write(new: Path) -> None:
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
                demos=dataset.sha256,
                files={name: sha256_of(new / name) for name in files},
                tasks=shards,
                provenance=provenance_of("kerv build datastore", settings, device),
            )
            write_json(new / stored.MANIFEST, stamped(asdict(manifest)))

        write_folder(folder, write)
        return folder, stored.Datastore.open(folder, target)

    def seconds() -> float:
        episode = dataset.load(every[0])
        of_one, _ = timed(device, lambda: entries_of(artifacts.target, episode, space, settings.key))
        return of_one * steps / episode.steps

    return Plan("datastore", folder, text, work, check, seconds)


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
