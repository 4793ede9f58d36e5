"""`kerv build datastore`: store demonstrated chunks, keyed by encoded observations (docs/methods.md §4.1)."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
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
from kerv_cli.base.spaces import ObservationSpace
from kerv_cli.lab.database import Database
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.heisd.datastore import (
    MANIFEST,
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
from kerv_cli.targets.observations import observations_of, observed_steps, prompts_of, read_chunks
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.settings import Begin, BuildDatastoreSettings, quietly
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.files import DemoEpisode

BATCH = 128
"""Maximum number of observations that are encoded together."""


def build_datastore(
    settings: BuildDatastoreSettings, database: Database, begin: Begin = quietly
) -> tuple[Path, Datastore]:
    """Write a datastore and open it. An older datastore in the same folder is replaced at the end.

    Args:
        settings: Settings of `kerv build datastore`.
        database: The database of the results folder.
        begin: Called once all settings are checked.

    Returns:
        The folder and the datastore.

    Raises:
        CheckpointError: The target or the demonstrations do not exist. Or the demonstrations are of another
            environment, contain evaluation seeds, have no episode of a task, have too few actions of the expert, or
            hold images of another size than the target takes.
        UsageError: `key` is empty. Or the folder holds something else than a datastore.
        UnknownName: `key` names an unknown part of the prompt.
        StorageError: The disk cannot be written.
    """
    if not settings.key:
        raise UsageError("key=[]: name at least one part of the prompt: scene, vision, proprioception")
    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, settings.policy, device=device, dtype=settings.runtime.dtype)
    settings, dataset = demos_for(settings, artifacts.description, database)
    tasks = sorted(resolve_tasks(settings.task or list(dataset.manifest.tasks)))
    folder = artifacts.new("datastore")
    is_store = (folder / MANIFEST).is_file() and read_mapping(folder / MANIFEST).get("kind") == "datastore"
    if not is_store and (folder.is_file() or visible(folder)):
        raise UsageError(f"{folder} exists and is no datastore: give the new one another name")
    chosen, seeds = first_episodes(dataset, tasks, settings.episodes)
    check_seeds(seeds, dataset.path)
    indices = [*itertools.chain(*chosen.values())]
    steps = sum(dataset.episodes[index].steps for index in indices)
    plan = (
        f"{count(len(indices), 'demonstration')} of {count(len(tasks), 'task')}, {steps} control steps, through "
        f"{artifacts.folder}, keys from {' + '.join(settings.key)}"
    )

    stage = begin("datastore", folder, f"{folder}: {plan}", 0)
    parts: list[dict[str, np.ndarray]] = []
    shards: dict[str, Shard] = {}
    rows, space = 0, dataset.manifest.observation
    with stage("encoding demonstrations") as progress:
        for name, episodes in chosen.items():
            first = rows
            for index in episodes:
                parts.append(entries_of(artifacts.target, dataset.load(index), space, settings.key))
                rows += len(parts[-1]["step"])
                progress(len(parts), len(indices))
            shards[name] = Shard((first, rows), tuple(seeds[name]))
    columns = {}
    for name in parts[0]:
        columns[name] = np.concatenate([part[name] for part in parts])
    files = contents_of(columns, shards, settings.components, settings.half)

    def write(new: Path) -> None:
        write_files(new, files)
        target = artifacts.description
        manifest = Manifest(
            format=2,
            kind="datastore",
            key=tuple(settings.key),
            width=files[VECTORS].shape[1],
            rows=len(files[VECTORS]),
            chunk=target.chunk,
            actions=target.actions,
            target=target.sha256,
            demos=dataset.sha256,
            files={name: sha256_of(new / name) for name in files},
            tasks=shards,
            provenance=provenance_of("kerv build datastore", settings, device),
        )
        write_json(new / MANIFEST, asdict(manifest))

    write_folder(folder, write)
    return folder, Datastore.open(folder, artifacts.description)


def first_episodes(
    dataset: DemoDataset, tasks: Sequence[str], limit: int
) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Return two dicts by task: the indices of the episodes with the lowest seeds, and these seeds.

    Args:
        dataset: The demonstrations.
        tasks: Full names of the tasks.
        limit: Maximum number of episodes per task; 0: all.
    """
    chosen, seeds = {}, {}
    for task in tasks:
        by_seed = sorted(dataset.of_tasks(task), key=lambda index: dataset.episodes[index].seed)
        chosen[task] = by_seed[: limit or None]
        seeds[task] = [dataset.episodes[index].seed for index in chosen[task]]
    return chosen, seeds


@torch.inference_mode()
def entries_of(target: Any, episode: DemoEpisode, space: ObservationSpace, key: Sequence[str]) -> dict[str, np.ndarray]:
    """Make the entries of an episode: one for every observation.

    Args:
        target: The target.
        episode: The episode.
        space: Observation space of the demonstrations.
        key: Parts of the prompt that make the key.

    Returns:
        The values of each column, one row per entry. The column `keys` holds the encoded observations, and `tokens` the
        expert's next H undisturbed actions.
    """
    steps = observed_steps(episode, bool(target.cameras))
    tokens = target.actions.chunk_tokens(read_chunks(episode, steps, target.chunk))
    observations = observations_of(target, episode, steps, space)
    size = -(-len(steps) // -(-len(steps) // BATCH))  # equal batches
    keys = [prompt_key(prompt, target, key).cpu().numpy() for prompt in prompts_of(target, observations, size)]
    return {
        "seed": np.full(len(steps), episode.seed),
        "step": steps.astype(np.int64),  # control steps since the start
        "left": episode.steps - steps,  # control steps until the success
        "tokens": tokens.astype(np.min_scalar_type(target.actions.tokens - 1)),
        "keys": np.concatenate(keys),
    }


def contents_of(
    columns: dict[str, np.ndarray], shards: Mapping[str, Shard], components: int, half: bool
) -> dict[str, Any]:
    """Return the content of each file of a datastore, an array or a table, by file name.

    Args:
        columns: The values of each column, one row per entry of all tasks.
        shards: For each task the range of its rows, and the seeds of its episodes.
        components: Number of directions that the keys are projected onto; 0: no projection.
        half: Whether keys are stored in float16.
    """
    keys, tokens, files = columns.pop("keys"), columns.pop("tokens"), {}
    if components:
        # the orthonormal directions that keep most of the keys' squared length
        values, vectors = np.linalg.eigh(keys.T.astype(np.float64) @ keys)
        files[PROJECTION] = vectors[:, np.argsort(-values)[:components]].astype(np.float32)
        keys = projected(keys, files[PROJECTION])
    files[VECTORS] = keys.astype(np.float16 if half else np.float32)
    counts = np.diff([shard.rows for shard in shards.values()])[:, 0]
    task = np.repeat(np.arange(len(shards), dtype=np.int32), counts)
    table = {
        "task": pa.DictionaryArray.from_arrays(task, [*shards]),
        **columns,
        "tokens": pa.FixedSizeListArray.from_arrays(pa.array(tokens.ravel()), tokens.shape[1]),
    }
    return {**files, PAYLOAD: pa.table(table)}


def write_files(folder: Path, files: Mapping[str, Any]) -> None:
    """Write arrays and tables, given by file name, into a folder."""
    for name, content in files.items():
        # write to memory first: on a full disk, numpy and pyarrow raise errors without an errno
        buffer = io.BytesIO()
        if name == PAYLOAD:
            pq.write_table(content, buffer, compression="zstd")
        else:
            np.save(buffer, content)
        (folder / name).write_bytes(buffer.getbuffer())
