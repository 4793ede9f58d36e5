"""The datastore: demonstrated chunks, found by similarity and merged into a draft tree (docs/methods.md §4.1, §4.2).

An entry has a key, made from an observation, and a chunk: the expert's next H actions as tokens. For the key, the
target encodes the observation as a prompt. The mean token of each chosen segment of the prompt is L2-normalised. These
vectors are concatenated, and the result is normalised again. By default the only segment is `scene`, which encodes
hand, object and goal. On MT10 a key with vision tokens finds less similar chunks.

A datastore is a folder with `vectors.npy` (rows, d) float32 or float16, `payload.parquet`, `manifest.json` and, if keys
are projected onto their leading directions, `projection.npy`. Rows are sorted by task, seed and step.

Shapes: B observations, P prompt tokens, E width of the target, d numbers of a key.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from kerv_cli.base.errors import CheckpointError, UnknownName
from kerv_cli.base.manifests import content_of
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.decisions import ROOT
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.methods.artifacts import Artifact, Artifacts
from kerv_cli.methods.heisd import MANIFEST
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.worlds import spec_of

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.engine.draft import Draft

VECTORS, PAYLOAD, PROJECTION = "vectors.npy", "payload.parquet", "projection.npy"
CROSS = 0.1  # assumed probability that a path of retrieved groups changes to another neighbour after a group
ROUNDING = 1e-5  # largest rounding error of a float32 dot product of two unit vectors
COLUMNS = {"seeds": "seed", "steps": "step", "left": "left"}


@dataclass(frozen=True)
class Shard:
    """The entries of one task. `rows` are the task's first row, and the row after its last row."""

    rows: tuple[int, int]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Manifest:
    """Contents of a datastore's `manifest.json`.

    Attributes:
        key: Segments of the prompt from which keys are made, such as `scene`.
        width: Length d of a key.
        rows: Number of entries.
        chunk: Number H of control steps per chunk.
        target: Hash of the target's weights.
        demos: Hash of the demonstrations.
        files: Hash of each file beside the manifest, by name.
        tasks: Rows and seeds of each task, by the task's full name.
    """

    format: Literal[2]
    kind: Literal["datastore"]
    key: tuple[str, ...]
    width: int
    rows: int
    chunk: int
    actions: ActionSpace
    target: str
    demos: str
    files: dict[str, str]
    tasks: dict[str, Shard]
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def content(self) -> str:
        return content_of(self.key, self.chunk, self.target, self.files)


def prompt_key(prompt: Tensor, target: ReadableTarget, segments: Sequence[str]) -> Tensor:
    """Make search keys from encoded observations: the mean tokens of some segments, normalised and concatenated.

    Args:
        prompt: (B, P, E) encoded prompts.

    Returns:
        (B, S · E) float32 keys for S segments, each with the norm 1.
    """
    import torch

    parts = target.segments
    for name in segments:
        if name not in parts:
            raise UnknownName("part of the prompt", name, parts)

    def unit(vectors: Tensor) -> Tensor:
        return vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True).clamp_min(1e-12)

    pooled = [unit(prompt[:, parts[name]].float().mean(1)) for name in segments]
    return unit(pooled[0] if len(pooled) == 1 else torch.cat(pooled, -1))


def projected(keys: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """Project keys (n, d) onto the directions `projection` (d, c). Return (n, c) float32 keys, each with the norm 1."""
    vectors = keys @ projection
    return (vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def check_seeds(seeds: Mapping[str, Sequence[int]], where: object) -> None:
    """Refuse seeds that are not training seeds. Otherwise retrieval would know the evaluation's initial states."""
    for task, numbers in seeds.items():
        training = spec_of(task).seeds.training
        shared = [seed for seed in numbers if seed not in training]
        if shared:
            raise CheckpointError(
                f"{where} holds seed {shared[0]} of {task}: seeds from {training.stop} on are for selection and "
                "evaluation. Retrieval would have seen the episodes of the evaluation. Build it from training seeds"
            )


def best(vectors: np.ndarray, rows: np.ndarray, key: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the k rows most similar to a key, and their similarities, both (k,), most similar first.

    Dot products are in float64, because the last bit of a float32 result depends on the row's index in the matrix.
    Equally similar rows are in ascending order.

    Args:
        vectors: (all rows, d) stored keys.
        key: (d,) search key.
    """
    scores = np.einsum("ij,j->i", vectors[rows].astype(np.float64), key.astype(np.float64)).astype(np.float32)
    order = np.argsort(-scores, kind="stable")[:k]
    return rows[order], scores[order]


@dataclass(frozen=True)
class Neighbours:
    """The k entries most similar to a key, most similar first. Equally similar entries keep the datastore's order."""

    similarity: np.ndarray  # (k,) float32, cosine
    chunks: np.ndarray  # (k, N) int64, tokens of the stored chunk
    seeds: np.ndarray  # (k,) int64, seed of the stored episode
    steps: np.ndarray  # (k,) int64, control step of the entry in the stored episode
    left: np.ndarray  # (k,) int64, control steps from the entry to the stored episode's end


@dataclass(frozen=True)
class Datastore:
    """An open datastore: keys and chunks of the demonstrations, in memory."""

    manifest: Manifest
    vectors: np.ndarray  # (rows, d) float32, keys
    tokens: np.ndarray  # (rows, N) uint8, chunks
    seeds: np.ndarray  # (rows,) int64, seed of the episode
    steps: np.ndarray  # (rows,) int64, control step in the episode
    left: np.ndarray  # (rows,) int64, control steps to the episode's end
    shards: dict[str, slice]  # full name of the task -> its rows
    projection: np.ndarray | None = None  # (numbers before projection, d); None: keys are not projected

    @functools.cached_property
    def longest(self) -> float:
        return float(np.linalg.norm(self.vectors, axis=1).max(initial=0.0))

    @classmethod
    def open(cls, folder: Path, description: TargetDescription) -> Datastore:
        """Open a datastore, and check that it was built for the described target."""
        manifest = DatastoreArtifact().checked(folder, description)
        rows, size = manifest.rows, manifest.actions.longest(manifest.chunk)
        try:
            vectors = np.load(folder / VECTORS).astype(np.float32, copy=False)
            projection = np.load(folder / PROJECTION) if PROJECTION in manifest.files else None
            payload = _read_payload(folder / PAYLOAD)
            if vectors.shape != (rows, manifest.width) or payload["tokens"].shape != (rows, size):
                raise ValueError("its files do not fit its manifest")
            if not np.isfinite(vectors).all():
                raise ValueError("its keys are not finite")
        except (OSError, KeyError, TypeError, ValueError, MemoryError) as error:  # pyarrow's errors are ValueErrors
            raise CheckpointError(f"the datastore in {folder} is damaged ({error}): build it again") from error
        shards = {task: slice(*shard.rows) for task, shard in manifest.tasks.items()}
        return cls(manifest, vectors, **payload, shards=shards, projection=projection)

    @property
    def tasks(self) -> Collection[str]:
        return self.shards

    def key_of(self, prompt: Tensor, target: ReadableTarget) -> np.ndarray:
        """Return the search key (d,) float32, on the CPU, of an encoded prompt (1, P, E)."""
        from kerv_cli.engine.draft import read

        (pooled,) = read(prompt_key(prompt, target, self.manifest.key)[0])
        key = pooled.astype(np.float32, copy=False)
        return key if self.projection is None else projected(key[None], self.projection)[0]

    def query(self, key: np.ndarray, task: str, k: int, without: int | None = None) -> Neighbours:
        """Return the k entries of a task that are most similar to a key (d,), or all entries if there are fewer.

        Args:
            without: Seed of an episode to leave out, for leave-one-episode-out measurements.
        """
        if task not in self.shards:
            raise UnknownName("task of the datastore", task, self.shards)
        key = np.asarray(key, dtype=np.float32)
        rows, similarity = best(self.vectors, self.candidates(key, self.shards[task], k, without), key, k)
        chunks = self.tokens[rows].astype(np.int64)
        return Neighbours(similarity, chunks, self.seeds[rows], self.steps[rows], self.left[rows])

    def candidates(self, key: np.ndarray, shard: slice, k: int, without: int | None) -> np.ndarray:
        """Return ascending numbers of all rows that can be among the k most similar, given float32 rounding errors."""
        scores = self.vectors[shard] @ key
        if without is not None:
            scores[self.seeds[shard] == without] = -np.inf
        least = np.partition(scores, -k)[-k] if k <= len(scores) else -np.inf
        slack = ROUNDING * self.longest * math.sqrt(key @ key)
        return np.flatnonzero((scores >= least - slack) & (scores > -np.inf)) + shard.start


def _read_payload(path: Path) -> dict[str, np.ndarray]:
    import pyarrow.parquet as pq

    # ParquetFile, because pyarrow's datasets take several times as long for a small file
    with pq.ParquetFile(path) as file:
        table = file.read(use_threads=False)
    columns = {name: table[column].to_numpy() for name, column in COLUMNS.items()}
    flat = table["tokens"].combine_chunks().flatten().to_numpy()
    return {"tokens": flat.reshape(len(table), -1), **columns}


class DatastoreArtifact(Artifact[Manifest]):
    """Finds, checks and loads datastores."""

    kind = noun = "datastore"
    made, command = "built", ("build", "datastore")
    schema = Manifest

    def json(self, path: Path) -> Path:
        return path / MANIFEST

    def read(self, path: Path) -> Manifest:
        manifest = super().read(path)
        check_seeds({task: shard.seeds for task, shard in manifest.tasks.items()}, path)
        return manifest

    def digest(self, path: Path, description: Manifest) -> str:
        return description.content

    def load(self, path: Path, artifacts: Artifacts) -> Datastore:
        return Datastore.open(path, artifacts.description)


# --- the draft tree (§4.2)


def neighbour_tree(
    chunks: np.ndarray, start: int, space: ActionSpace, nodes: int = 50, depth: int | None = None, cross: float = CROSS
) -> Draft:
    """Merge the neighbours' chunks into one tree of kinematic groups (docs/methods.md §4.2).

    A kinematic group is the position, rotation or gripper tokens of one control step. Every path of the tree consists
    of whole groups. After a group, a path may continue with the next group of any neighbour. But if the next group is
    strict (the gripper), it must come from a neighbour whose chunk also contains the path's last group.

    If the tree would be too large, only the most probable groups are kept (our addition to the paper). The i-th
    neighbour has the weight 1 / i, and a path changes to another neighbour with probability `cross`.

    Args:
        chunks: (k, N) tokens, most similar neighbour first.
        depth: Maximum number of tokens on a path. If None, paths end with the chunk.
        cross: If 0, paths never change, so only whole chunks are merged.
    """
    from kerv_cli.engine.draft import Draft

    stop = chunks.shape[1] if depth is None else min(chunks.shape[1], start + depth)
    # sets of neighbours are numbers, whose bits stand for neighbours
    everyone = (1 << len(chunks)) - 1
    levels: list[tuple[bool, list[tuple[tuple[int, ...], int]]]] = []  # is strict; each group, and who has it
    for first, end, strict in space.segments(start, stop):
        givers: dict[tuple[int, ...], int] = {}
        for i, row in enumerate(chunks[:, first:end].tolist()):
            givers[tuple(row)] = givers.get(tuple(row), 0) | 1 << i
        levels.append((strict, list(givers.items())))
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    # groups to add: (−log probability of their path, order of offers, parent node, number of groups before, tokens,
    # `last` and `whole` as in `offer`)
    waiting: list[tuple[float, int, int, int, tuple[int, ...], int, int]] = []
    order = count()

    def offer(parent: int, level: int, last: int, whole: int, cost: float) -> None:
        """Put the groups that can extend a path into `waiting`, those of the most similar neighbours first.

        `last`: neighbours that contain the path's final group. `whole`: neighbours that contain all its groups since
        the path switched to another neighbour for the last time.
        """
        strict, givers = levels[level] if level < len(levels) else (False, [])
        pool = last if strict else everyone
        if strict:
            givers = [(group, members & last) for group, members in givers if members & last]
            givers.sort(key=lambda way: way[1] & -way[1])
        for group, members in givers:
            common = members & whole
            chance = (1 - cross) * _weight(common) / _weight(whole) + cross * _weight(members) / _weight(pool)
            if chance > 0:
                heappush(
                    waiting, (cost - math.log(chance), next(order), parent, level, group, members, common or members)
                )

    offer(ROOT, 0, everyone, everyone, 0.0)
    while waiting and len(tokens) < nodes:
        cost, _, node, level, group, last, whole = heappop(waiting)
        known = 0  # number of leading tokens of the group that are in the tree already
        while known < len(group) and (node, group[known]) in children:
            node, known = children[node, group[known]], known + 1
        if len(tokens) + len(group) - known > nodes:
            continue  # never add a group in part
        for token in group[known:]:
            children[node, token] = len(tokens)
            parents.append(node)
            node = len(tokens)
            tokens.append(token)
        if group[-1] != space.end:
            offer(node, level + 1, last, whole, cost)
    return Draft.of(tokens, parents)


@functools.lru_cache(maxsize=4096)
def _weight(members: int) -> float:
    return sum([1 / (1 + i) for i in range(members.bit_length()) if members >> i & 1])
