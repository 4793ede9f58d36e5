"""Exact search for the best scores among a task's vectors (docs/methods.md §4.1).

Between two searches the target's weights displace the vectors from the processor's cache, so reading all of them costs
memory bandwidth. `ExactIndex` first reads an outline: a few numbers per row that give an upper bound of its score. It
then reads only the vectors whose bound reaches the k-th best score.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

ROUNDING = 1e-5  # bounds the rounding of a float32 product of unit vectors
OUTLINE = 24  # directions that hold nearly all of a shard's keys: of MT10's, all but 5e-4 of their squared length
SAMPLE = 256  # rows that the directions are taken from


class Index(Protocol):
    """Finds candidate rows; it may return more than k, `best` ranks them."""

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        """Rows, ascending, among which are the task's k best for key (d,) float32; `without`: seed passed over."""


def best(vectors: np.ndarray, rows: np.ndarray, key: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The k best of `rows`, ascending -> (rows, scores float32), best first, equal scores in the rows' order.

    The last bit of a float32 product depends on a row's place in the matrix, so rows are compared in float64.
    """
    scores = np.einsum("ij,j->i", vectors[rows].astype(np.float64), key.astype(np.float64)).astype(np.float32)
    order = np.argsort(-scores, kind="stable")[:k]
    return rows[order], scores[order]


def slack(longest: float, key: np.ndarray) -> float:
    """Bound of the rounding error between two float32 scores. longest: norm of the longest vector. key: (d,)."""
    return ROUNDING * longest * math.sqrt(key @ key)


def length_of_longest(vectors: np.ndarray) -> float:
    """Largest Euclidean norm among the rows of vectors (n, d); 0 without rows."""
    return float(np.linalg.norm(vectors, axis=1).max(initial=0.0))


@dataclass(frozen=True)
class Outline:
    """A shard projected on p orthonormal directions: v = inside + rest, so v · key ≤ inside · inside' + |rest| |rest'|,
    primes for the key's parts."""

    vectors: np.ndarray  # (n, d) float32
    directions: np.ndarray  # (d, p)
    outline: np.ndarray  # (p + 1, n): coordinates inside, then the length of the rest
    longest: float

    @classmethod
    def of(cls, vectors: np.ndarray) -> Outline:
        """Outline of vectors (n, d): directions from the SVD of an evenly spaced sample of rows."""
        sample = vectors[:: max(1, len(vectors) // SAMPLE)]
        directions = np.linalg.svd(sample, full_matrices=False)[2][:OUTLINE].T
        inside = vectors @ directions
        rest = np.linalg.norm(vectors - inside @ directions.T, axis=1)
        outline = np.vstack([inside.T, rest])
        return cls(vectors, np.ascontiguousarray(directions), outline, length_of_longest(vectors))

    def candidates(self, key: np.ndarray, k: int, passed: np.ndarray | None) -> np.ndarray:
        """Rows, ascending, among which are the k best for key (d,). passed: (n,) bool, rows passed over."""
        inside = key @ self.directions
        rest = key - self.directions @ inside
        bounds = np.concatenate((inside, [math.sqrt(rest @ rest)]), dtype=np.float32) @ self.outline
        if passed is not None:
            bounds[passed] = -np.inf
        if k >= len(bounds) - (0 if passed is None else np.count_nonzero(passed)):
            return np.flatnonzero(bounds > -np.inf)
        first = (bounds >= np.partition(bounds, -k)[-k]).nonzero()[0]
        least = (self.vectors[first] @ key).min()  # k rows score this much
        return (bounds >= least - slack(self.longest, key)).nonzero()[0]


def exact_index(
    vectors: np.ndarray, seeds: np.ndarray, shards: Mapping[str, slice], digest: str, settings: object
) -> ExactIndex:
    """datastore=exact."""
    return ExactIndex(vectors, seeds, shards)


class ExactIndex:
    """The default: in this process, numpy."""

    def __init__(self, vectors: np.ndarray, seeds: np.ndarray, shards: Mapping[str, slice]) -> None:
        self.seeds, self.shards = seeds, shards
        self.outlines = {task: Outline.of(vectors[shard]) for task, shard in shards.items()}

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        """See `Index`; from the task's outline."""
        shard = self.shards[task]
        passed = None if without is None else self.seeds[shard] == without
        return self.outlines[task].candidates(key, k, passed) + shard.start
