"""The Qdrant backend finds the neighbours of exact search: the engine in process, and a server's client."""

from __future__ import annotations

import importlib.util
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kerv_cli.base.errors import StorageError, UnknownName, UsageError
from kerv_cli.base.registry import find as find_part
from kerv_cli.methods.heisd import QdrantSearchSettings
from kerv_cli.methods.heisd import qdrant as module
from kerv_cli.methods.heisd.datastore import Datastore, Manifest
from kerv_cli.worlds.metaworld.spec import SPEC

pytestmark = pytest.mark.filterwarnings("ignore:Local mode performs exact:UserWarning")
BACKENDS = ("engine", "server")
ROWS = {"a": slice(0, 60), "b": slice(60, 61), "c": slice(61, 300)}
Open = Callable[..., Datastore]


@pytest.fixture
def local_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The client's own imitation of a server, one that outlives the connections to it."""
    client = pytest.importorskip("qdrant_client")
    kept = client.QdrantClient(":memory:")
    monkeypatch.setattr(kept, "create_payload_index", lambda *arguments: None)  # has no effect there, and warns
    monkeypatch.setattr(client, "QdrantClient", lambda **options: kept)
    yield kept
    kept.close()


@pytest.fixture(params=BACKENDS)
def searched(request: pytest.FixtureRequest) -> Open:
    """vectors, seeds -> a datastore that Qdrant searches."""
    if request.param == "server":
        request.getfixturevalue("local_server")
    else:
        pytest.importorskip("qdrant_edge")
    from kerv_cli.methods.heisd.qdrant import QdrantIndex

    def open_(vectors: np.ndarray, seeds: np.ndarray, digest: str = "d" * 64) -> Datastore:
        url = "http://nowhere" if request.param == "server" else None
        return store(vectors, seeds, QdrantIndex(vectors, seeds, ROWS, digest, url))

    return open_


def store(vectors: np.ndarray, seeds: np.ndarray, index: Any = None) -> Datastore:
    rows = np.arange(len(vectors))
    tokens = np.stack([rows % 251, rows // 251], 1).astype(np.uint8)
    files = {"vectors.npy": "v" * 64, "payload.parquet": "p" * 64}
    shape = (*vectors.shape[::-1], 4, SPEC.actions)
    manifest = Manifest(2, "datastore", ("scene",), *shape, "t" * 64, "d" * 64, files, {})
    return Datastore(manifest, vectors, tokens, seeds, rows, rows, ROWS, index=index)


def vectors_of(kind: str, width: int) -> np.ndarray:
    rng = np.random.default_rng(width)
    if kind == "ties":  # small whole numbers: few different scores
        return rng.integers(-1, 2, (300, width)).astype(np.float32)
    vectors = rng.normal(size=(300, width)).astype(np.float32)
    if kind == "still":  # a robot that stands still: the same key again and again, up to rounding
        vectors[:] = vectors[0] + 1e-7 * vectors
        vectors[61:150] = vectors[0]
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.bits
@pytest.mark.parametrize("kind", ["random", "ties", "still"])
@pytest.mark.parametrize("width", [3, 48])
def test_the_neighbours_are_those_of_exact_search(searched: Open, kind: str, width: int) -> None:
    vectors, seeds = vectors_of(kind, width), np.random.default_rng(1).integers(0, 4, 300)
    exact, qdrant = store(vectors, seeds), searched(vectors, seeds)
    keys = [*vectors[[0, 61]], vectors[:7].mean(0), np.zeros(width, np.float32)]
    for key in keys:
        for task in ROWS:
            for k, without in ((1, None), (5, None), (5, 2), (17, 0), (1000, None), (1000, 3)):
                expected, actual = exact.query(key, task, k, without), qdrant.query(key, task, k, without)
                assert actual.steps.tolist() == expected.steps.tolist(), (task, k, without)
                assert actual.similarity.tolist() == expected.similarity.tolist()
                assert actual.chunks.tolist() == expected.chunks.tolist()
                assert without is None or without not in actual.seeds


def test_a_server_keeps_a_datastore_and_completes_one_that_was_cut(local_server: Any) -> None:
    from kerv_cli.methods.heisd.qdrant import QdrantIndex

    vectors, seeds = vectors_of("random", 8), np.arange(300)
    filled: list[int] = []
    real = local_server.upsert
    local_server.upsert = lambda name, batch, wait: (filled.append(len(batch.ids)), real(name, batch, wait=wait))

    def opened(digest: str) -> int:
        filled.clear()
        QdrantIndex(vectors, seeds, ROWS, digest * 64, "http://nowhere")
        return sum(filled)

    assert [opened("a"), opened("a"), opened("b")] == [300, 0, 300]
    local_server.delete(f"kerv-{'a' * 32}", [5, 250])
    assert [opened("a"), opened("a")] == [300, 0]
    assert sorted(c.name for c in local_server.get_collections().collections) == [f"kerv-{d * 32}" for d in "ab"]


def test_a_server_is_asked_for_exact_search(local_server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from kerv_cli.methods.heisd.qdrant import QdrantIndex

    vectors, asked, real = vectors_of("random", 8), [], local_server.query_points
    monkeypatch.setattr(local_server, "query_points", lambda *a, **more: (asked.append(more), real(*a, **more))[1])
    index = QdrantIndex(vectors, np.arange(300), ROWS, "d" * 64, "http://nowhere")
    assert len(index.candidates(vectors[70], "c", 5, None)) == 13
    assert [more["search_params"].exact for more in asked] == [True]


def test_the_engines_files_go_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("qdrant_edge")
    from kerv_cli.methods.heisd.qdrant import EmbeddedEngine

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    engine = EmbeddedEngine(3)
    assert len(list(tmp_path.iterdir())) == 1
    with pytest.raises(StorageError, match=r"cannot keep its vectors in .*: Vector dimension error") as caught:
        engine.put(0, np.zeros((1, 2), np.float32), [{"task": "a", "seed": 0}])
    assert "\n" not in str(caught.value)
    engine.close()
    assert not list(tmp_path.iterdir())


def test_a_server_that_does_not_answer_gets_one_line() -> None:
    pytest.importorskip("qdrant_client")
    from kerv_cli.methods.heisd.qdrant import QdrantIndex

    with socket.socket() as taken:  # a port where nobody listens
        taken.bind(("127.0.0.1", 0))
        for url in (f"http://127.0.0.1:{taken.getsockname()[1]}", "http://127.0.0.1:no"):
            with pytest.raises(UsageError) as caught:
                QdrantIndex(vectors_of("random", 3), np.arange(300), ROWS, "d" * 64, url)
            assert str(caught.value).startswith(f"datastore.url={url}: no Qdrant server answers (")
            assert "\n" not in str(caught.value)


def test_a_backend_that_cannot_work_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownName, match=r"unknown datastore 'qdrnt': did you mean qdrant"):
        find_part("datastore", "qdrnt")
    vectors, seeds = vectors_of("random", 3), np.arange(300)
    for missing, chosen in (
        ("qdrant_edge", QdrantSearchSettings()),
        ("qdrant_client", QdrantSearchSettings(url="http://here")),
    ):
        with monkeypatch.context() as without:
            without.delitem(sys.modules, missing, raising=False)
            without.setattr(module, "find_spec", lambda name, gone=missing: None if name == gone else find(name))
            with pytest.raises(UsageError) as caught:
                find_part("datastore", "qdrant").built(vectors, seeds, ROWS, "d" * 64, chosen)
        assert str(caught.value) == "datastore=qdrant needs the extra: pip install 'kerv[qdrant]'"


find = importlib.util.find_spec
