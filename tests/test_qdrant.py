"""Qdrant finds the neighbours of exact search; tried with the client's local mode."""

from typing import Any

import numpy as np
import pytest
from loaded import datastore_of

from kerv_cli.base.errors import UsageError
from kerv_cli.methods.heisd import QdrantSearchSettings
from kerv_cli.methods.heisd.datastore import ExactIndex, best

ROWS = {"a": slice(0, 60), "b": slice(60, 61), "c": slice(61, 300)}
SEEDS = np.random.default_rng(1).integers(0, 4, 300)


@pytest.fixture(scope="module", autouse=True)
def client():
    pytest.importorskip("qdrant_client")


def searched(vectors: np.ndarray, shards: dict[str, slice] = ROWS, **where: str) -> Any:
    tokens = np.arange(len(vectors))[:, None]
    return datastore_of(vectors, tokens, shards, SEEDS[: len(vectors)], search=QdrantSearchSettings(**where)).index


def vectors_of(kind: str, width: int) -> np.ndarray:
    rng = np.random.default_rng(width)
    if kind == "ties":  # small whole numbers: few different scores
        return rng.integers(-1, 2, (300, width)).astype(np.float32)
    vectors = rng.normal(size=(300, width)).astype(np.float32)
    if kind == "still":  # a robot that does not move: the same key again and again, except for rounding
        vectors[:] = vectors[0] + 1e-7 * vectors
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.bits
@pytest.mark.parametrize("kind", ["random", "ties", "still"])
@pytest.mark.parametrize("width", [3, 48])
def test_the_neighbours_are_those_of_exact_search(kind, width):
    vectors = vectors_of(kind, width)
    qdrant = searched(vectors)
    exact = ExactIndex(qdrant.store, None)
    for key in (vectors[0], vectors[61], vectors[:7].mean(0), np.zeros(width, np.float32)):
        for task in ROWS:
            for k, without in ((1, None), (5, 2), (17, 0), (1000, 3)):
                found = (best(vectors, index.candidates(key, task, k, without), key, k) for index in (exact, qdrant))
                (expected, scores), (rows, similarity) = found
                assert (rows.tolist(), similarity.tolist()) == (expected.tolist(), scores.tolist())


def test_a_folder_is_kept_and_completed(tmp_path):
    vectors, shards = vectors_of("random", 8)[:20], {"a": slice(0, 20)}
    for removed in ([2, 17], [3]):
        index = searched(vectors, shards, path=str(tmp_path))
        assert 17 in index.candidates(vectors[17], "a", 1, None)
        index.client.delete(index.name, removed)
        index.client.close()


def test_what_cannot_be_used_gets_one_line(tmp_path):
    (tmp_path / "file").touch()
    for name, value in (("url", "http://127.0.0.1:9"), ("url", "http://127.0.0.1:no"), ("path", tmp_path / "file")):
        with pytest.raises(UsageError, match=rf"datastore.{name}={value}: Qdrant cannot search here \([^\n]*\)$"):
            searched(vectors_of("random", 3), **{name: str(value)})
