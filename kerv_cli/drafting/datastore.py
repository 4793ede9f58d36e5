"""Retrieval: the demonstrations' action chunks, found by what the target itself sees (METHODS §4.1, §4.2; HeiSD).

The key is the target's own prompt, pooled: of each chosen segment the mean token, L2-normalised, and the whole
normalised again. The default is the scene segment alone, which holds the vision encoder's object and goal positions
together with hand and gripper. Measured on MT10, nearest neighbour in another episode, its chunks agree best; pooled
patch tokens agree worse and lower the agreement of what they are added to. The payload is the expert's next H actions
as tokens.

On disk: `vectors.npy` (rows, d) float32 or float16, `payload.parquet`, `manifest.json`; rows by task, seed, step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kerv_cli.drafting.groups import Groups, segments
from kerv_cli.drafting.search import ExactIndex, Index, best
from kerv_cli.drafting.tree import ROOT, TokenTree
from kerv_cli.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.files import read_json, sha256_of
from kerv_cli.settings import EVALUATION_SEED, DatastoreSettings
from kerv_cli.targets.checkpoint import TargetDescription

FORMAT = 1
FILES = ("vectors.npy", "payload.parquet")
REQUIRED = ("key", "width", "rows", "chunk", "dofs", "actions", "target", "demos", "files", "tasks")
CROSS = 0.1  # probability that a path leaves the neighbours that it has followed
COLUMNS = {"seeds": "seed", "steps": "step", "left": "left"}
BACKENDS = ("exact", "qdrant")


def prompt_key(prompt: Tensor, known: Mapping[str, slice], segments: Sequence[str]) -> np.ndarray:
    """prompt (B, P, E) -> keys (B, d) float32 of length 1, d = segments · E. known: where the target's prompt has its
    parts.

    Raises:
        UnknownName: a segment that this target's prompt does not have.
    """
    for name in segments:
        if name not in known:
            raise UnknownName("part of the prompt", name, known)
    pooled = [_unit(prompt[:, known[name]].float().mean(1)) for name in segments]
    return _unit(pooled[0] if len(pooled) == 1 else torch.cat(pooled, -1)).cpu().numpy()


def _unit(vectors: Tensor) -> Tensor:
    return vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True).clamp_min(1e-12)


def check_seeds(seeds: Mapping[str, Sequence[int]], where: object) -> None:
    """Prove that training and evaluation share no world: seeds per task, all below the first evaluation seed.

    Raises:
        CheckpointError: one is not.
    """
    for task, used in seeds.items():
        shared = [seed for seed in used if seed >= EVALUATION_SEED]
        if shared:
            raise CheckpointError(
                f"{where} holds seed {shared[0]} of {task}: seeds from {EVALUATION_SEED} on are for evaluation, "
                "retrieval would know the worlds it is judged on; build it from training demonstrations"
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

    manifest: dict[str, Any]
    vectors: np.ndarray  # (rows, d) float32
    tokens: np.ndarray  # (rows, N) uint8
    seeds: np.ndarray  # (rows,) int64, as the next two
    steps: np.ndarray
    left: np.ndarray
    shards: dict[str, slice]

    index: Index | None = None  # who searches; None: ExactIndex

    def __post_init__(self) -> None:
        if self.index is None:
            object.__setattr__(self, "index", ExactIndex(self.vectors, self.seeds, self.shards))

    @classmethod
    def open(cls, folder: Path, description: TargetDescription) -> Datastore:
        """With exact search; see `open_datastore`."""
        return cls(**_read(folder, description))

    def key(self, prompt: Tensor, segments: Mapping[str, slice]) -> np.ndarray:
        """prompt (1, P, E) of the target, and where its parts lie -> (d,) float32."""
        return prompt_key(prompt, segments, self.manifest["key"])[0]

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


def open_datastore(folder: Path, description: TargetDescription, settings: DatastoreSettings) -> Datastore:
    """A datastore, searched by the backend asked for; every backend finds the same neighbours.

    description: the target's, as `load_target` returns it.

    Raises:
        CheckpointError: no datastore there, a damaged one, one that was built for another target, other action
            statistics or another chunk length, or from evaluation seeds.
        UsageError: an unknown backend, one whose packages are not installed, a server that does not answer.
    """
    check_backend(settings)
    parts = _read(folder, description)
    if settings.backend == "exact":
        return Datastore(**parts)
    from kerv_cli.drafting.qdrant import QdrantIndex

    digest = sha256_of(folder / "manifest.json")
    index = QdrantIndex(parts["vectors"], parts["seeds"], parts["shards"], digest, settings.url)
    return Datastore(**parts, index=index)


def check_backend(settings: DatastoreSettings) -> None:
    """Refuse a backend that cannot work here, before anything is loaded.

    Raises:
        UsageError: an unknown one, one whose packages are not installed, a server for a search in this process.
    """
    if settings.backend not in BACKENDS:
        raise UnknownName("datastore.backend", settings.backend, BACKENDS)
    if settings.backend == "exact" and settings.url is not None:
        raise UsageError(f"datastore.url={settings.url}: exact search is in this process, use datastore.backend=qdrant")
    if settings.backend == "qdrant" and find_spec("qdrant_client" if settings.url else "qdrant_edge") is None:
        raise UsageError("datastore.backend=qdrant needs the extra: pip install 'kerv[qdrant]'")


def _read(folder: Path, description: TargetDescription) -> dict[str, Any]:
    """What a datastore's files hold, checked against each other and the target."""
    manifest = read_manifest(folder)
    check_target(manifest, description, folder)
    try:
        vectors = np.load(folder / FILES[0]).astype(np.float32, copy=False)
        payload = _read_payload(folder / FILES[1])
        shards = {task: slice(*shard["rows"]) for task, shard in manifest["tasks"].items()}
        rows, size = manifest["rows"], manifest["chunk"] * manifest["dofs"]
        fits = vectors.shape == (rows, manifest["width"]) and payload["tokens"].shape == (rows, size)
    except (OSError, KeyError, TypeError, ValueError) as error:  # pyarrow's errors are ValueErrors
        raise CheckpointError(f"the datastore in {folder} is damaged ({error}): build it again") from error
    if not fits:
        raise CheckpointError(f"the datastore in {folder} is damaged: its files differ in length, build it again")
    return {"manifest": manifest, "vectors": vectors, "shards": shards, **payload}


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a datastore whose files are as they were written and whose seeds are training seeds.

    Raises:
        CheckpointError: missing, damaged, of another format, or from evaluation seeds.
    """
    path = folder / "manifest.json"
    if not path.is_file():
        raise CheckpointError(f"no datastore in {folder}: build one with 'kerv build datastore'")
    manifest = read_json(path)
    if not isinstance(manifest, dict) or (manifest.get("format"), manifest.get("kind")) != (FORMAT, "datastore"):
        raise CheckpointError(f"{path} is not a datastore of format {FORMAT}: build it again")
    missing = [name for name in REQUIRED if name not in manifest]
    if missing:
        raise CheckpointError(f"{path} is damaged, it has no {missing[0]}: build the datastore again")
    try:
        for name in FILES:
            if sha256_of(folder / name) != manifest["files"][name]:
                raise CheckpointError(f"{folder / name} does not match its manifest: build the datastore again")
        check_seeds({task: shard["seeds"] for task, shard in manifest["tasks"].items()}, folder)
    except (KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path} is damaged ({error}): build the datastore again") from error
    return manifest


def check_target(manifest: Mapping[str, Any], description: TargetDescription, folder: Path) -> None:
    """Refuse a datastore whose keys or tokens mean something else to this target.

    Raises:
        CheckpointError: another chunk length, other action statistics, other weights.
    """
    again, dofs = "build one with 'kerv build datastore'", description.actions.dofs
    if (manifest["chunk"], manifest["dofs"]) != (description.chunk, dofs):
        raise CheckpointError(
            f"the datastore in {folder} holds chunks of {manifest['chunk']} steps of {manifest['dofs']} DoFs, the "
            f"target decodes {description.chunk} of {dofs}: {again}"
        )
    if manifest["actions"] != {"low": list(description.actions.low), "high": list(description.actions.high)}:
        raise CheckpointError(
            f"the datastore in {folder} was made with other action statistics than the target's, the same token is "
            f"another action there: {again}"
        )
    if manifest["target"] != description.sha256:
        raise CheckpointError(
            f"the datastore in {folder} was built for target {manifest['target'][:12]}, not for "
            f"{description.sha256[:12]}: {again}"
        )


def _read_payload(path: Path) -> dict[str, np.ndarray]:
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    columns = {name: table[column].to_numpy() for name, column in COLUMNS.items()}
    flat = table["tokens"].combine_chunks().flatten().to_numpy()
    return {"tokens": flat.reshape(len(table), -1), **columns}


def neighbour_tree(
    chunks: np.ndarray,
    start: int,
    groups: Groups,
    nodes: int = 50,
    depth: int | None = None,
    cross: float = CROSS,
) -> TokenTree:
    """The neighbours' chunks behind `start` committed tokens as one tree, merged by kinematic group (METHODS §4.2).

    chunks: (k, N) tokens, best neighbour first. A path is made of whole groups: behind each it may go on with any
    neighbour's next one, but a gripper's group always comes from a neighbour that gave the group before it, too. The
    tree has at most `nodes` nodes and reaches `depth` tokens deep (default: to the chunk's end).

    Which groups are kept is *ours*: the most probable ones, when the i-th neighbour has weight 1 / i and a path leaves
    the neighbours that it has followed with probability `cross`; 0 keeps to the neighbours' own chunks.
    """
    stop = chunks.shape[1] if depth is None else min(chunks.shape[1], start + depth)
    ways = _Ways(chunks.tolist(), list(segments(start, stop, groups)), cross)
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    waiting: list[tuple[float, int, int, int, tuple[int, ...], int, int]] = []
    order = count()

    def offer(parent: int, level: int, gave: int, followed: int, cost: float) -> None:
        for surprise, group, given, staying in ways.on(level, gave, followed):
            heappush(waiting, (cost + surprise, next(order), parent, level, group, given, staying))

    offer(ROOT, 0, ways.everyone, ways.everyone, 0.0)
    while waiting and len(tokens) < nodes:
        cost, _, node, level, group, gave, followed = heappop(waiting)
        if len(tokens) + len(group) - _shared(children, node, group) > nodes:
            continue  # a group is in the tree as a whole or not at all
        for token in group:
            if (node, token) not in children:
                children[node, token] = len(tokens)
                tokens.append(token)
                parents.append(node)
            node = children[node, token]
        offer(node, level + 1, gave, followed, cost)
    return TokenTree.build(tokens, parents)


class _Weights(dict[int, float]):
    """Of a set of neighbours, bit i for the i-th: the sum of their weights 1 / i, counted from 1."""

    def __missing__(self, members: int) -> float:
        weight = sum([1 / (1 + i) for i in range(members.bit_length()) if members >> i & 1])
        self[members] = weight
        return weight


class _Ways:
    """The groups that a path may go on with. Behind a path lie two sets of neighbours: those that gave its last group,
    and those of them that gave the groups before it, too."""

    def __init__(self, rows: list[list[int]], cuts: list[tuple[int, int, bool]], cross: float) -> None:
        self.everyone = (1 << len(rows)) - 1
        self.cross, self.weights = cross, _Weights()
        self.levels: list[tuple[bool, list[tuple[tuple[int, ...], int]]]] = []
        for first, last, gripper in cuts:
            givers: dict[tuple[int, ...], int] = {}
            for i, row in enumerate(rows):
                group = tuple(row[first:last])
                givers[group] = givers.get(group, 0) | 1 << i
            self.levels.append((gripper, list(givers.items())))

    def on(self, level: int, gave: int, followed: int) -> Iterator[tuple[float, tuple[int, ...], int, int]]:
        """Minus the logarithm of its probability, tokens, and the two sets behind the path then. Best giver first."""
        if level == len(self.levels):
            return
        gripper, givers = self.levels[level]
        pool = self.everyone
        if gripper:
            pool = gave
            givers = [(group, given & gave) for group, given in givers if given & gave]
            givers.sort(key=lambda way: way[1] & -way[1])
        weights, cross = self.weights, self.cross
        of_followed, of_pool = weights[followed], weights[pool]
        for group, given in givers:
            staying = given & followed
            probability = (1 - cross) * weights[staying] / of_followed + cross * weights[given] / of_pool
            if probability > 0:
                yield -math.log(probability), group, given, staying or given


def _shared(children: Mapping[tuple[int, int], int], node: int, group: Sequence[int]) -> int:
    """How many of the group's first tokens are in the tree already."""
    for depth, token in enumerate(group):
        if (node, token) not in children:
            return depth
        node = children[node, token]
    return len(group)
