"""The datastore: action chunks of the demonstrations, searched by the target's encoding (docs/methods.md §4.1; HeiSD).

The key is the target's own prompt, pooled: the mean token of each chosen segment, L2-normalised, and the whole
normalised again. It may be projected onto the directions that hold nearly all of the keys. The default is the scene
segment alone: the encoder's positions of object and goal with hand and gripper. On MT10 the nearest neighbour by this
key in another episode has the most similar chunk; pooled patch tokens make it worse. The stored value is the expert's
next H actions as tokens.

On disk: `vectors.npy` (rows, d) float32 or float16, `payload.parquet`, `projection.npy` if keys are projected, and
`manifest.json`. Rows are sorted by task, seed and step.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base import registry
from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.manifests import content_of
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.methods.artifacts import Artifact, Artifacts
from kerv_cli.methods.heisd import MANIFEST, QdrantSearchSettings
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.worlds import spec_of

VECTORS, PAYLOAD, PROJECTION = "vectors.npy", "payload.parquet", "projection.npy"
COLUMNS = {"seeds": "seed", "steps": "step", "left": "left"}
AGAIN = "build one with 'kerv build datastore'"
MARGIN = 8  # rows that Qdrant returns beyond k; if these may tie with the k-th too, all rows of the task are candidates
ROUNDING = 1e-5  # bounds the rounding of a float32 product of unit vectors


@dataclass(frozen=True)
class Shard:
    """One task's part: its rows [first, last) and the seeds of its episodes."""

    rows: tuple[int, int]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Manifest:
    """`manifest.json`: the entries' keys and sizes, the target they were made for, and their seeds.

    Attributes:
        key: Segments of the prompt that are pooled.
        width: Numbers of a key.
        chunk: H.
        actions: The target's action space.
        target: Hash of the target's weights.
        demos: Hash of the demonstrations.
        files: Name -> hash of the files beside this one.
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
        """Hash over keys, chunks and target. A rebuild from the same target and demonstrations keeps it."""
        return content_of(self.key, self.chunk, self.target, self.files)


def prompt_key(prompt: Tensor, target: ReadableTarget, segments: Sequence[str]) -> Tensor:
    """Return the keys (B, d) float32 of length 1 of prompts (B, P, E), with d = segments · E.

    Raises:
        UnknownName: A segment that this target's prompt does not have.
    """
    parts = target.segments
    for name in segments:
        if name not in parts:
            raise UnknownName("part of the prompt", name, parts)
    pooled = [_unit(prompt[:, parts[name]].float().mean(1)) for name in segments]
    return _unit(pooled[0] if len(pooled) == 1 else torch.cat(pooled, -1))


def _unit(vectors: Tensor) -> Tensor:
    return vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True).clamp_min(1e-12)


def projected(keys: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """Return keys (n, d) along the directions projection (d, c): (n, c) float32 of length 1."""
    vectors = keys @ projection
    units: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return units.astype(np.float32)


def check_seeds(seeds: Mapping[str, Sequence[int]], where: object) -> None:
    """Check that no stored episode has the initial state of an evaluation episode.

    Args:
        seeds: Seeds per task.
        where: The folder, for the message.

    Raises:
        CheckpointError: One is no training seed.
    """
    for task, numbers in seeds.items():
        training = spec_of(task).seeds.training
        shared = [seed for seed in numbers if seed not in training]
        if shared:
            raise CheckpointError(
                f"{where} holds seed {shared[0]} of {task}: seeds from {training.stop} on are for selection and "
                "evaluation. Retrieval would have seen the episodes of the evaluation. Build it from training seeds"
            )


class Index(Protocol):
    """Finds candidate rows. It may return more than k, because `best` ranks them."""

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        """Return rows, ascending, among which are the task's k best for a key.

        Args:
            key: (d,) float32.
            task: Full name.
            k: Number of rows wanted.
            without: Seed of an episode that is left out.
        """


def best(vectors: np.ndarray, rows: np.ndarray, key: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the k best of `rows` (ascending) and their scores float32, best first; equal scores in the rows' order.

    The last bit of a float32 product depends on a row's place in the matrix, so rows are compared in float64.
    """
    scores = np.einsum("ij,j->i", vectors[rows].astype(np.float64), key.astype(np.float64)).astype(np.float32)
    order = np.argsort(-scores, kind="stable")[:k]
    return rows[order], scores[order]


class ExactIndex:
    """datastore=exact, the default: one matrix product in this process."""

    def __init__(self, store: Datastore, settings: object) -> None:
        self.store = store

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        """Return candidate rows, also those that rounding may have put after the k-th."""
        shard = self.store.shards[task]
        scores = self.store.vectors[shard] @ key
        if without is not None:
            scores[self.store.seeds[shard] == without] = -np.inf
        least = np.partition(scores, -k)[-k] if k <= len(scores) else -np.inf
        slack = ROUNDING * self.store.longest * math.sqrt(key @ key)
        return np.flatnonzero((scores >= least - slack) & (scores > -np.inf)) + shard.start


class QdrantIndex:
    """datastore=qdrant: search by a server, or by the client itself, in a folder or in memory (the extra `qdrant`).

    Qdrant searches exactly within a task. `best` ranks its results again, so that the neighbours equal those of exact
    search. A collection is named by the datastore's hash, so a folder or server keeps it for later processes.
    """

    def __init__(self, store: Datastore, settings: QdrantSearchSettings) -> None:
        """Open the collection of this datastore, and fill it if it is not complete.

        Raises:
            UsageError: qdrant-client is not installed, or the server or folder cannot be used.
        """
        if find_spec("qdrant_client") is None:
            raise UsageError("datastore=qdrant needs the extra: pip install 'kerv[qdrant]'")
        from qdrant_client import QdrantClient, models

        self.store, self.models, self.name, self.settings = store, models, f"kerv-{store.content[:32]}", settings
        with self._errors():
            memory = None if settings.url or settings.path else ":memory:"
            self.client = QdrantClient(memory, url=settings.url, path=settings.path, check_compatibility=False)
            if not self.client.collection_exists(self.name):
                parameters = models.VectorParams(size=store.vectors.shape[1], distance=models.Distance.DOT)
                self.client.create_collection(self.name, parameters)
            if self.client.count(self.name).count != len(store.vectors):  # new, or filled in part
                tasks = [(task, row) for task, shard in store.shards.items() for row in range(shard.start, shard.stop)]
                payloads = [{"task": task, "seed": int(store.seeds[row])} for task, row in tasks]
                rows = [row for _, row in tasks]
                self.client.upload_collection(self.name, store.vectors[rows], payloads, rows, wait=True)

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        """Return candidate rows, see `Index`."""
        m, store, shard = self.models, self.store, self.store.shards[task]
        must = [m.FieldCondition(key="task", match=m.MatchValue(value=task))]
        other = [] if without is None else [m.FieldCondition(key="seed", match=m.MatchValue(value=without))]
        exact = m.SearchParams(exact=True) if self.settings.url else None  # local mode has no other search
        how = {"search_params": exact, "limit": k + MARGIN, "with_payload": False}
        with self._errors():
            chosen = m.Filter(must=must, must_not=other)
            found = self.client.query_points(self.name, key.tolist(), query_filter=chosen, **how).points
        rows = np.sort(np.array([point.id for point in found], dtype=np.int64))
        if len(found) < k + MARGIN:
            return rows
        slack = 2 * ROUNDING * store.longest * math.sqrt(key @ key)
        if found[-1].score < best(store.vectors, rows, key, k)[1][-1] - slack:
            return rows
        return np.flatnonzero(store.seeds[shard] != without) + shard.start

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # the client raises errors of many libraries
            where = " ".join(f"datastore.{name}={value}" for name, value in vars(self.settings).items() if value)
            raise UsageError(f"{where}: Qdrant cannot search here ({' '.join(str(error).split())})") from error


@dataclass(frozen=True)
class Neighbours:
    """The k nearest entries, best first; equal scores in the datastore's order."""

    similarity: np.ndarray  # (k,) float32, cosine
    chunks: np.ndarray  # (k, N) int64 tokens
    seeds: np.ndarray  # (k,) int64, the stored episodes
    steps: np.ndarray  # (k,) int64, control step of the stored episode
    left: np.ndarray  # (k,) int64, control steps from there to the stored episode's end


@dataclass(frozen=True)
class Datastore:
    """An opened datastore."""

    manifest: Manifest
    vectors: np.ndarray  # (rows, d) float32
    tokens: np.ndarray  # (rows, N) uint8
    seeds: np.ndarray  # (rows,) int64, as the next two
    steps: np.ndarray
    left: np.ndarray
    shards: dict[str, slice]
    projection: np.ndarray | None = None  # (pooled numbers, d)
    search: Any = None  # settings of the search; None: exact. Each finds the same neighbours

    @functools.cached_property
    def index(self) -> Index:
        """The search."""
        kind = self.search.kind if self.search else "exact"
        index: Index = registry.find("datastore", kind, "datastore.kind").built(self, self.search)
        return index

    @functools.cached_property
    def longest(self) -> float:
        """Length of the longest vector."""
        return float(np.linalg.norm(self.vectors, axis=1).max(initial=0.0))

    @classmethod
    def open(cls, folder: Path, description: TargetDescription, search: Any = None) -> Datastore:
        """Open the datastore in `folder`, made for the target described.

        Args:
            folder: Its folder.
            description: The target's.
            search: Settings of the search; None for exact search.

        Raises:
            CheckpointError: No datastore there, a damaged one, one that was built for another target, other action
                statistics or another chunk length, or from evaluation seeds.
            UsageError: An unknown search, one whose packages are not installed, or a server that does not answer.
        """
        manifest = DatastoreArtifact().checked(folder, description)
        store = cls(manifest, **_arrays(folder, manifest), search=search)
        _ = store.index  # a search that does not work is refused now
        return store

    @property
    def tasks(self) -> Collection[str]:
        """Tasks that have entries."""
        return self.shards

    @property
    def content(self) -> str:
        """Hash over keys, chunks and target, see `Manifest.content`."""
        return self.manifest.content

    def pooled(self, prompt: Tensor, target: ReadableTarget) -> Tensor:
        """Return the pooled prompt (p,) float32 for `key_of`, on the device; prompt (1, P, E)."""
        return prompt_key(prompt, target, self.manifest.key)[0]

    def key_of(self, pooled: np.ndarray) -> np.ndarray:
        """Return the key (d,) float32 of a pooled prompt (p,)."""
        return pooled if self.projection is None else projected(pooled[None], self.projection)[0]

    def query(self, key: np.ndarray, task: str, k: int, without: int | None = None) -> Neighbours:
        """Return the k nearest entries of a task, or all if there are fewer.

        Args:
            key: (d,).
            task: Full name.
            k: Number of entries.
            without: Seed of an episode that is left out, for leave-one-episode-out measurements.

        Raises:
            UnknownName: A task that the datastore does not hold.
        """
        if task not in self.shards:
            raise UnknownName("task of the datastore", task, self.shards)
        key = np.asarray(key, dtype=np.float32)
        rows, similarity = best(self.vectors, self.index.candidates(key, task, k, without), key, k)
        chunks = self.tokens[rows].astype(np.int64)
        return Neighbours(similarity, chunks, self.seeds[rows], self.steps[rows], self.left[rows])


def _arrays(folder: Path, manifest: Manifest) -> dict[str, Any]:
    """Read a datastore's files and check them against its manifest."""
    try:
        vectors = np.load(folder / VECTORS).astype(np.float32, copy=False)
        payload = _read_payload(folder / PAYLOAD)
        projection = np.load(folder / PROJECTION) if PROJECTION in manifest.files else None
        rows, size = manifest.rows, manifest.chunk * manifest.actions.dofs
        fits = vectors.shape == (rows, manifest.width) and payload["tokens"].shape == (rows, size)
    except (OSError, KeyError, TypeError, ValueError, MemoryError) as error:  # pyarrow's errors are ValueErrors
        raise CheckpointError(f"the datastore in {folder} is damaged ({error}): build it again") from error
    if not fits or not np.isfinite(vectors).all():
        raise CheckpointError(
            f"the datastore in {folder} is damaged: its files do not fit its manifest, build it again"
        )
    shards = {task: slice(*shard.rows) for task, shard in manifest.tasks.items()}
    return {"vectors": vectors, "shards": shards, "projection": projection, **payload}


def _read_payload(path: Path) -> dict[str, np.ndarray]:
    import pyarrow.parquet as pq

    # without pyarrow's dataset machinery, which takes several times as long for a small file
    with pq.ParquetFile(path) as file:
        table = file.read(use_threads=False)
    columns = {name: table[column].to_numpy() for name, column in COLUMNS.items()}
    flat = table["tokens"].combine_chunks().flatten().to_numpy()
    return {"tokens": flat.reshape(len(table), -1), **columns}


class DatastoreArtifact(Artifact[Manifest]):
    """The datastore's files."""

    kind = noun = "datastore"
    made, command, again = "built", ("build", "datastore"), AGAIN
    schema = Manifest

    def json(self, path: Path) -> Path:
        """Return the path of `manifest.json`."""
        return path / MANIFEST

    def read(self, path: Path) -> Manifest:
        """Return the manifest. Its seeds must be training seeds."""
        manifest = super().read(path)
        check_seeds({task: shard.seeds for task, shard in manifest.tasks.items()}, path)
        return manifest

    def digest(self, path: Path, description: Manifest) -> str:
        """Return `Manifest.content`."""
        return description.content

    def load(self, path: Path, artifacts: Artifacts) -> Datastore:
        """Return the datastore, opened."""
        return Datastore.open(path, artifacts.description, artifacts.search)
