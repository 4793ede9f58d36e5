"""Building a datastore: the demonstrations through the target's encoder, onto disk in one piece (METHODS §4.1)."""

from __future__ import annotations

import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kerv_cli.drafting.datastore import FILES, FORMAT, Datastore, check_seeds, prompt_key
from kerv_cli.environments import resolve_tasks
from kerv_cli.environments.demos.dataset import DemoDataset
from kerv_cli.environments.demos.episode_file import DemoEpisode
from kerv_cli.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.files import atomic_path, read_json, sha256_of, storage_errors, write_json
from kerv_cli.places import artifact, beside, find_target
from kerv_cli.provenance import provenance
from kerv_cli.runtime import set_up
from kerv_cli.settings import EVALUATION_SEED, BuildDatastoreSettings, TargetSettings
from kerv_cli.targets.checkpoint import TargetDescription, load_target
from kerv_cli.targets.compact.target import CompactTarget, Inputs
from kerv_cli.training.imitation import instruction_of, observed

BATCH = 128  # observations encoded at once
WITHIN = 9  # bins; the share of tokens this close is reported (Spec-VLA's relaxed radius)


def datastore_beside(target: Path) -> Path:
    """Shipped: pretrained/<name>/{target,datastore}; built: artifacts/target/<name> and artifacts/datastore/<name>."""
    return beside(target, "datastore")


@dataclass(frozen=True)
class Entries:
    """One episode's part of the datastore: n rows in step order."""

    keys: np.ndarray  # (n, d) float32
    tokens: np.ndarray  # (n, N) uint8
    steps: np.ndarray  # (n,) int64
    left: np.ndarray  # (n,) int64


def observed_steps(episode: DemoEpisode, settings: TargetSettings) -> np.ndarray:
    """Control steps that become entries: with a frame for a vision policy, all of them for a state policy.

    Raises:
        CheckpointError: too few labels behind the episode's end for a whole chunk, frames of another size.
    """
    tail = len(episode.labels) - episode.steps
    if settings.chunk > tail + 1:
        raise CheckpointError(
            f"the demonstrations have {tail} labels behind an episode's end, chunks of {settings.chunk} need "
            f"{settings.chunk - 1}: record them again with a longer tail"
        )
    if settings.observation == "state":
        return np.arange(episode.steps)
    if episode.frames.shape[1] != settings.image_size:
        raise CheckpointError(
            f"the demonstrations' frames have {episode.frames.shape[1]} pixels, the policy takes {settings.image_size}:"
            " record them again with world.camera.size"
        )
    return episode.frame_steps


@torch.inference_mode()
def entries_of(target: CompactTarget, episode: DemoEpisode, segments: list[str], stride: int = 1) -> Entries:
    """Every `stride`-th of the episode's observations as key, and behind each the expert's next H clean actions. A
    chunk that begins near the end takes the labels recorded beyond the success: it never reaches into another episode.
    """
    settings = target.settings
    steps = observed_steps(episode, settings)[::stride]
    felt, states = (torch.from_numpy(x) for x in observed(episode, steps, target.observation))
    frames = torch.from_numpy(episode.frames[::stride]).permute(0, 3, 1, 2) if target.cameras else None
    words = target.words_of(instruction_of(episode.task))
    keys = []
    for rows in torch.arange(len(steps)).split(BATCH):
        images = frames[rows].to(target.device) if frames is not None else None
        told = words.expand(len(rows), -1)
        inputs = Inputs(images, felt[rows].to(target.device), states[rows].to(target.device), told)
        keys.append(prompt_key(target.encode_batch(inputs)[0], target.segments, segments))
    chunks = np.stack([episode.labels[t : t + settings.chunk] for t in steps])
    tokens = target.actions.encode(chunks).reshape(len(steps), -1).astype(np.uint8)
    return Entries(np.concatenate(keys), tokens, steps.astype(np.int64), (episode.steps - steps).astype(np.int64))


class DatastoreBuild:
    """`kerv build datastore`. What cannot be built is refused here, before anything heavy starts.

    Raises:
        CheckpointError: no such target or demonstrations, evaluation seeds among them, a task without an episode.
        UsageError: an unknown part of the prompt, a folder that holds something else.
    """

    def __init__(self, settings: BuildDatastoreSettings) -> None:
        self.settings = settings
        tasks = sorted(resolve_tasks(settings.task))
        self.target_folder = find_target(settings.results, settings.policy.target)
        target, _ = load_target(self.target_folder)
        known = target.segments
        for name in settings.key:
            if name not in known:
                raise UnknownName("key", name, known)
        if not settings.key or settings.episodes < 0 or settings.stride < 1:
            raise UsageError(
                f"key={settings.key} episodes={settings.episodes} stride={settings.stride}: name a key, episodes from "
                "0 on, stride from 1 on"
            )
        beside = datastore_beside(self.target_folder)
        self.folder = artifact(settings.results, "datastore", settings.name) if settings.name else beside
        self.dataset = DemoDataset.open(artifact(settings.results, "demos", settings.demos))
        self.chosen = {name: self._episodes_of(name) for name in tasks}
        check_seeds(self.seeds, self.dataset.path)
        _refuse_foreign(self.folder)

    def _episodes_of(self, name: str) -> list[int]:
        """Indices of the task's episodes in the dataset, by seed."""
        entries = self.dataset.episodes
        found = sorted((i for i, e in enumerate(entries) if e.task == name), key=lambda i: entries[i].seed)
        if not found:
            raise CheckpointError(f"the demonstrations in {self.dataset.path} hold no episode of {name}")
        return found[: self.settings.episodes or None]

    @property
    def seeds(self) -> dict[str, list[int]]:
        """Seeds of the episodes that go in, per task."""
        return {name: [self.dataset.episodes[i].seed for i in chosen] for name, chosen in self.chosen.items()}

    def plan(self) -> str:
        episodes = [i for chosen in self.chosen.values() for i in chosen]
        steps = sum(self.dataset.episodes[i].steps for i in episodes)
        return (
            f"{self.folder}: {len(episodes)} demonstrations of {len(self.chosen)} tasks, {steps} control steps, "
            f"through {self.target_folder}, keys from {' + '.join(self.settings.key)}"
        )

    def build(self, progress: Callable[[int, int], None] = lambda done, total: None) -> Datastore:
        """Write the datastore; it appears complete or not at all, and replaces an older one as a whole."""
        device, dtype = set_up(self.settings.runtime)
        target, description = load_target(self.target_folder, device, dtype)
        total, parts, seeds, shards, rows = sum(map(len, self.chosen.values())), [], [], {}, 0
        for name, chosen in self.chosen.items():
            first = rows
            for index in chosen:
                episode = self.dataset.load(index)
                parts.append(entries_of(target, episode, self.settings.key, self.settings.stride))
                seeds.append(np.full(len(parts[-1].steps), episode.seed))
                rows += len(parts[-1].steps)
                progress(len(parts), total)
            shards[name] = {"rows": [first, rows], "seeds": self.seeds[name]}
        manifest = self._manifest(target, description, shards, rows, device)
        with _new_folder(self.folder) as folder:
            _write(folder, parts, np.concatenate(seeds), manifest, np.float16 if self.settings.half else np.float32)
        return Datastore.open(self.folder, description)

    def _manifest(
        self, target: CompactTarget, description: TargetDescription, shards: dict[str, Any], rows: int, device: str
    ) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "kind": "datastore",
            "key": list(self.settings.key),
            "width": len(self.settings.key) * target.settings.width,
            "rows": rows,
            "chunk": target.settings.chunk,
            "dofs": target.actions.dofs,
            "actions": {"low": list(description.actions.low), "high": list(description.actions.high)},
            "target": description.sha256,
            "demos": self.dataset.sha256,
            "first_evaluation_seed": EVALUATION_SEED,
            "tasks": shards,
            "provenance": {
                "command": "kerv build datastore",
                "settings": asdict(self.settings),
                **provenance(device),
            },
        }


def leave_one_out(store: Datastore, per_task: int = 200) -> dict[str, float]:
    """How well an entry's nearest neighbour in *another* episode predicts its chunk; `per_task` evenly spread entries
    of each task. Shares of tokens, the median similarity, and the median seconds of a search for five neighbours."""
    gaps, similarities, seconds = [], [], []
    for name, shard in store.shards.items():
        if len(store.manifest["tasks"][name]["seeds"]) < 2:
            continue
        for row in np.linspace(shard.start, shard.stop - 1, min(per_task, shard.stop - shard.start)).astype(int):
            began = time.perf_counter()
            store.query(store.vectors[row], name, 5)
            seconds.append(time.perf_counter() - began)
            found = store.query(store.vectors[row], name, 1, without=int(store.seeds[row]))
            gaps.append(np.abs(found.chunks[0] - store.tokens[row]))
            similarities.append(found.similarity[0])
    if not gaps:
        return {}
    gap = np.stack(gaps)
    return {
        "token_agreement": float((gap == 0).mean()),
        f"within_{WITHIN}": float((gap <= WITHIN).mean()),
        "similarity": float(np.median(similarities)),
        "query_ms": 1000 * float(np.median(seconds)),
    }


def _write(folder: Path, parts: list[Entries], seeds: np.ndarray, manifest: dict[str, Any], dtype: type) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    tokens = np.concatenate([p.tokens for p in parts])
    names = list(manifest["tasks"])
    counts = [shard["rows"][1] - shard["rows"][0] for shard in manifest["tasks"].values()]
    task_column = pa.DictionaryArray.from_arrays(np.repeat(np.arange(len(names), dtype=np.int32), counts), names)
    columns = {
        "task": task_column,
        "seed": seeds,
        "step": np.concatenate([p.steps for p in parts]),
        "left": np.concatenate([p.left for p in parts]),
        "tokens": pa.FixedSizeListArray.from_arrays(pa.array(tokens.ravel()), tokens.shape[1]),
    }
    with atomic_path(folder / FILES[0]) as temporary, temporary.open("wb") as file:
        np.save(file, np.concatenate([p.keys for p in parts]).astype(dtype))
    with atomic_path(folder / FILES[1]) as temporary:
        pq.write_table(pa.table(columns), temporary, compression="zstd")
    files = {name: sha256_of(folder / name) for name in FILES}
    write_json(folder / "manifest.json", {**manifest, "files": files})


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that becomes `folder` when the block ends well; what lay there goes when the new one is there.

    Raises:
        StorageError: the disk refused.
    """
    mark = f"{os.getpid()}-{secrets.token_hex(4)}"
    new, old = (folder.with_name(f".{folder.name}.{mark}.{state}.tmp") for state in ("new", "old"))
    try:
        with storage_errors(folder):
            new.mkdir(parents=True)
            yield new
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
    finally:
        if old.exists() and not folder.exists():
            old.rename(folder)
        for leftover in (new, old):
            shutil.rmtree(leftover, ignore_errors=True)


def _refuse_foreign(folder: Path) -> None:
    """A datastore may be replaced, nothing else."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    manifest = folder / "manifest.json"
    described = read_json(manifest) if manifest.is_file() else None
    if not isinstance(described, dict) or described.get("kind") != "datastore":
        raise UsageError(f"{folder} exists and is no datastore: give the new one another name")
