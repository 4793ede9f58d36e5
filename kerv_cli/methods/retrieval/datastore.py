"""Retrieval: action chunks of the demonstrations, searched by the target's own encoding of the observation
(docs/methods.md §4.1, §4.2; HeiSD).

The key is the target's own prompt, pooled: of each chosen segment the mean token, L2-normalised, and the whole
normalised again; optionally projected onto the directions that hold nearly all of the keys. The default is the scene
segment alone, which holds the vision encoder's object and goal positions together with hand and gripper. On MT10 the
nearest neighbour by this key in another episode has the most similar chunk; adding pooled patch tokens makes the
agreement worse. The payload is the expert's next H actions as tokens.

On disk: `vectors.npy` (rows, d) float32 or float16, `payload.parquet`, `projection.npy` where keys are projected, and
`manifest.json`; rows by task, seed, step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base import registry
from kerv_cli.base.errors import CheckpointError, UnknownName
from kerv_cli.base.files import read_table, regular
from kerv_cli.base.manifests import content_of
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.draft import ROOT, Draft
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.engine.transfer import read
from kerv_cli.methods.artifacts import Artifact, Request
from kerv_cli.methods.context import Context
from kerv_cli.methods.retrieval.search import ExactIndex, Index, best
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.worlds import spec_of

VECTORS, PAYLOAD, PROJECTION = "vectors.npy", "payload.parquet", "projection.npy"
CROSS = 0.1  # probability that a path changes to other neighbours
COLUMNS = {"seeds": "seed", "steps": "step", "left": "left"}
AGAIN = "build one with 'kerv build datastore'"


@dataclass(frozen=True)
class Shard:
    """One task's part: its rows [first, last) and the seeds of its episodes."""

    rows: tuple[int, int]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Manifest:
    """`manifest.json`: the entries' keys and sizes, the target they were made for, and their seeds.

    key: parts of the prompt that are pooled. width: numbers of a key. chunk: H. actions: the target's action space.
    target, demos, files: SHA-256 of the target's weights, the demonstrations and the files beside this one.
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

    def __post_init__(self) -> None:
        if not {VECTORS, PAYLOAD} <= set(self.files):
            raise ValueError("a file has no hash")
        for task, shard in self.tasks.items():
            if not 0 <= shard.rows[0] < shard.rows[1] <= self.rows:
                raise ValueError(f"the rows of {task} are not among {self.rows}")

    @property
    def content(self) -> str:
        """SHA-256 over keys, chunks and target; a rebuild from the same target and demonstrations keeps it."""
        return content_of(self.key, self.chunk, self.target, self.files)


def prompt_key(prompt: Tensor, target: ReadableTarget, segments: Sequence[str]) -> np.ndarray:
    """prompt (B, P, E) -> keys (B, d) float32 of length 1, on the host; errors as `pooled_key`."""
    return pooled_key(prompt, target, segments).cpu().numpy()


def pooled_key(prompt: Tensor, target: ReadableTarget, segments: Sequence[str]) -> Tensor:
    """prompt (B, P, E) -> keys (B, d) float32 of length 1, d = segments · E.

    Raises:
        UnknownName: a segment that this target's prompt does not have.
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
    """keys (n, d) along the directions projection (d, c) -> (n, c) float32 of length 1."""
    vectors = keys @ projection
    units: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return units.astype(np.float32)


def check_seeds(seeds: Mapping[str, Sequence[int]], where: object) -> None:
    """Checks that all seeds (per task) are training seeds, so that no stored episode has the initial state of an
    evaluation episode.

    Raises:
        CheckpointError: one is not.
    """
    for task, numbers in seeds.items():
        training = spec_of(task).seeds.training
        shared = [seed for seed in numbers if seed not in training]
        if shared:
            raise CheckpointError(
                f"{where} holds seed {shared[0]} of {task}: seeds from {training.stop} on are for selection and "
                "evaluation, retrieval would have seen the episodes it is evaluated on; build it from training ones"
            )


@dataclass(frozen=True)
class Neighbours:
    """The k nearest entries, best first; equal scores in the datastore's order."""

    similarity: np.ndarray  # (k,) float32, cosine
    chunks: np.ndarray  # (k, N) int64 tokens
    seeds: np.ndarray  # (k,) int64, the stored episodes
    steps: np.ndarray  # (k,) int64, control step of the stored episode
    left: np.ndarray  # (k,) int64, control steps from there to the stored episode's end

    def __len__(self) -> int:
        return len(self.similarity)


@dataclass(frozen=True)
class Datastore:
    """An opened datastore. shards: task -> its rows."""

    manifest: Manifest
    vectors: np.ndarray  # (rows, d) float32
    tokens: np.ndarray  # (rows, N) uint8
    seeds: np.ndarray  # (rows,) int64, as the next two
    steps: np.ndarray
    left: np.ndarray
    shards: dict[str, slice]
    projection: np.ndarray | None = None  # (pooled numbers, d)
    index: Index | None = None  # the search; None: ExactIndex

    def __post_init__(self) -> None:
        if self.index is None:
            object.__setattr__(self, "index", ExactIndex(self.vectors, self.seeds, self.shards))

    @classmethod
    def open(cls, folder: Path, description: TargetDescription, search: Any = None) -> Datastore:
        """The datastore in `folder`, made for the target described.

        search: settings of the search (registry kind datastore), None for exact search; each finds the same neighbours.

        Raises:
            CheckpointError: no datastore there, a damaged one, one that was built for another target, other action
                statistics or another chunk length, or from evaluation seeds.
            UsageError: an unknown backend, one whose packages are not installed, a server that does not answer.
        """
        manifest = DatastoreArtifact().checked(folder, description)
        parts = _arrays(folder, manifest)
        index = None
        if search is not None:
            part = registry.find("datastore", search.kind, "datastore.kind")
            index = part.built(parts["vectors"], parts["seeds"], parts["shards"], manifest.content, search)
        return cls(manifest, **parts, index=index)

    @property
    def content(self) -> str:
        """SHA-256 over keys, chunks and target, see `Manifest.content`."""
        return self.manifest.content

    def key(self, prompt: Tensor, target: ReadableTarget) -> np.ndarray:
        """prompt (1, P, E) of the target -> (d,) float32."""
        return self.key_of(self.pooled(prompt, target).cpu().numpy())

    def pooled(self, prompt: Tensor, target: ReadableTarget) -> Tensor:
        """prompt (1, P, E) of the target -> pooled (p,) float32 for `key_of`, on the device."""
        return pooled_key(prompt, target, self.manifest.key)[0]

    def key_of(self, pooled: np.ndarray) -> np.ndarray:
        """pooled (p,) float32 -> (d,) float32."""
        return pooled if self.projection is None else projected(pooled[None], self.projection)[0]

    def query(self, key: np.ndarray, task: str, k: int, without: int | None = None) -> Neighbours:
        """Exact search among the entries of `task`: key (d,) -> its k nearest (all, where there are fewer).

        without: seed of an episode that is passed over, for leave-one-episode-out measurements.

        Raises:
            UnknownName: a task that the datastore does not hold.
        """
        if task not in self.shards:
            raise UnknownName("task of the datastore", task, self.shards)
        assert self.index is not None
        key = np.asarray(key, dtype=np.float32)
        at, similarity = best(self.vectors, self.index.candidates(key, task, k, without), key, k)
        return Neighbours(similarity, self.tokens[at].astype(np.int64), self.seeds[at], self.steps[at], self.left[at])


def _arrays(folder: Path, manifest: Manifest) -> dict[str, Any]:
    """Reads a datastore's files and checks them against its manifest."""
    try:
        vectors = np.load(regular(folder / VECTORS)).astype(np.float32, copy=False)
        payload = _read_payload(folder / PAYLOAD)
        projection = np.load(regular(folder / PROJECTION)) if PROJECTION in manifest.files else None
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
    table = read_table(path)
    columns = {name: table[column].to_numpy() for name, column in COLUMNS.items()}
    flat = table["tokens"].combine_chunks().flatten().to_numpy()
    return {"tokens": flat.reshape(len(table), -1), **columns}


class DatastoreArtifact(Artifact[Manifest]):
    """The datastore's files."""

    kind = noun = "datastore"
    made, command, again = "built", ("build", "datastore"), AGAIN
    schema = Manifest

    def json(self, path: Path) -> Path:
        """`manifest.json`."""
        return path / "manifest.json"

    def read(self, path: Path) -> Manifest:
        """See `Artifact.read`; the seeds must be training seeds."""
        manifest = super().read(path)
        check_seeds({task: shard.seeds for task, shard in manifest.tasks.items()}, path)
        return manifest

    def digest(self, path: Path, description: Manifest) -> str:
        """`Manifest.content`."""
        return description.content

    def load(self, path: Path, request: Request) -> Datastore:
        """The datastore, opened."""
        return Datastore.open(path, request.description, request.search)


def neighbour_tree(
    chunks: np.ndarray,
    start: int,
    space: ActionSpace,
    nodes: int = 50,
    depth: int | None = None,
    cross: float = CROSS,
) -> Draft:
    """The neighbours' chunks behind `start` committed tokens as one tree by kinematic group (docs/methods.md §4.2).

    chunks: (k, N) tokens, best neighbour first. A path is made of whole groups: behind each it may go on with any
    neighbour's next one, but a group of strict DoFs always comes from a neighbour that has the group before it, too.
    The tree has at most `nodes` nodes and reaches `depth` tokens deep (default: to the chunk's end).

    Within `nodes` the most probable groups are kept (*ours*): the i-th neighbour weighs 1 / i, and a path changes to
    other neighbours with probability `cross`; 0 merges whole chunks only.
    """
    stop = chunks.shape[1] if depth is None else min(chunks.shape[1], start + depth)
    continuations = _Continuations(chunks.tolist(), list(space.segments(start, stop)), cross)
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    waiting: list[tuple[float, int, int, int, tuple[int, ...], int, int]] = []
    order = count()

    def offer(parent: int, level: int, last: int, whole: int, cost: float) -> None:
        for surprise, group, members, common in continuations.on(level, last, whole):
            heappush(waiting, (cost + surprise, next(order), parent, level, group, members, common))

    offer(ROOT, 0, continuations.everyone, continuations.everyone, 0.0)
    while waiting and len(tokens) < nodes:
        cost, _, node, level, group, last, whole = heappop(waiting)
        if len(tokens) + len(group) - _shared(children, node, group) > nodes:
            continue  # a group is in the tree as a whole or not at all
        for token in group:
            if (node, token) not in children:
                children[node, token] = len(tokens)
                tokens.append(token)
                parents.append(node)
            node = children[node, token]
        offer(node, level + 1, last, whole, cost)
    return Draft.of(tokens, parents)


class _Weights(dict[int, float]):
    """Bit set of neighbours -> sum of their weights; the i-th neighbour, counted from 1, weighs 1 / i."""

    def __missing__(self, members: int) -> float:
        weight = sum([1 / (1 + i) for i in range(members.bit_length()) if members >> i & 1])
        self[members] = weight
        return weight


class _Continuations:
    """The groups that may follow a path. A path is described by two sets of neighbours: `last`, those that have its
    last group, and `whole`, those among them that have all its groups."""

    def __init__(self, rows: list[list[int]], cuts: list[tuple[int, int, bool]], cross: float) -> None:
        self.everyone = (1 << len(rows)) - 1
        self.cross, self.weights = cross, _Weights()
        self.levels: list[tuple[bool, list[tuple[tuple[int, ...], int]]]] = []
        for first, last, strict in cuts:
            givers: dict[tuple[int, ...], int] = {}
            for i, row in enumerate(rows):
                group = tuple(row[first:last])
                givers[group] = givers.get(group, 0) | 1 << i
            self.levels.append((strict, list(givers.items())))

    def on(self, level: int, last: int, whole: int) -> Iterator[tuple[float, tuple[int, ...], int, int]]:
        """Yields (−log probability, the group's tokens, the two sets of the lengthened path), best neighbour first."""
        if level == len(self.levels):
            return
        strict, givers = self.levels[level]
        pool = self.everyone
        if strict:
            pool = last
            givers = [(group, members & last) for group, members in givers if members & last]
            givers.sort(key=lambda way: way[1] & -way[1])
        weights, cross = self.weights, self.cross
        of_whole, of_pool = weights[whole], weights[pool]
        for group, members in givers:
            common = members & whole
            probability = (1 - cross) * weights[common] / of_whole + cross * weights[members] / of_pool
            if probability > 0:
                yield -math.log(probability), group, members, common or members


def _shared(children: Mapping[tuple[int, int], int], node: int, group: Sequence[int]) -> int:
    """Number of the group's leading tokens that the tree already has below `node`."""
    for depth, token in enumerate(group):
        if (node, token) not in children:
            return depth
        node = children[node, token]
    return len(group)


class RetrievalProposer(ChainProposer):
    """The nearest stored chunks of the task, merged by kinematic group (docs/methods.md §4.2)."""

    name = "retrieval"

    def __init__(self, datastore: Datastore, target: ReadableTarget, neighbours: int, nodes: int) -> None:
        self.datastore, self.target, self.count, self.nodes = datastore, target, neighbours, nodes
        self.waits = target.device.type == "cpu"
        self._nearest: tuple[Chunk, Neighbours] | None = None

    @classmethod
    def build(cls, settings: Any, context: Context) -> RetrievalProposer:
        """proposer=retrieval, and retrieval's side of hybrid: settings of either have neighbours and nodes."""
        return cls(context.artifact("datastore"), context.target, settings.neighbours, settings.nodes)

    @classmethod
    def of_nearest(cls, context: Context) -> RetrievalProposer:
        """Retrieval of the one best chunk."""
        return cls(context.artifact("datastore"), context.target, 1, 1)

    def neighbours(self, chunk: Chunk) -> Neighbours:
        """The task's nearest entries to this observation; searched once per chunk. Sets `chunk.similarity`."""
        if self._nearest is None or self._nearest[0] is not chunk:
            self._search(chunk, read(self.datastore.pooled(chunk.prompt, self.target))[0])
        assert self._nearest is not None
        return self._nearest[1]

    def prepare(self, chunk: Chunk) -> None:
        """Adds the pooled prompt, which the search key is made of, to `chunk.reads`."""
        if not self.waits and (self._nearest is None or self._nearest[0] is not chunk):
            vector = self.datastore.pooled(chunk.prompt, self.target)
            chunk.reads.append((vector, lambda pooled: self._search(chunk, pooled)))

    def _search(self, chunk: Chunk, pooled: np.ndarray) -> None:
        key = self.datastore.key_of(pooled.astype(np.float32, copy=False))
        self._nearest = chunk, self.datastore.query(key, chunk.situation.task, self.count)
        chunk.similarity = float(self._nearest[1].similarity[0])

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """The neighbours' chunks as one tree, merged by kinematic group."""
        chunks = self.neighbours(chunk).chunks[:, : chunk.size]
        return neighbour_tree(chunks, len(chunk.tokens), chunk.space, self.nodes, depth)

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Each neighbour's remaining tokens as a chain of its own, best neighbour first."""
        start = len(chunk.tokens)
        return self.neighbours(chunk).chunks[:, start : min(chunk.size, start + depth)].tolist()
