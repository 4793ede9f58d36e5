"""Search by Qdrant (docs/methods.md §4.1): its engine in this process, or a server. The extra: kerv[qdrant].

Qdrant searches exactly within a task. Its results are ranked again by `datastore.best`, so that the neighbours equal
those of exact search. The engine keeps its files in a temporary folder of this process; a server's collection is named
by the datastore's hash and is reused by later processes.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import numpy as np

from kerv_cli.base.errors import StorageError, UsageError
from kerv_cli.methods.heisd import QdrantSearchSettings
from kerv_cli.methods.heisd.datastore import best, length_of_longest, slack

BATCH = 131_072  # numbers sent at once: below a server's limit for one request
MARGIN = 8  # rows requested beyond k, so that ties at the k-th place seldom need a second search
TIMEOUT = 10  # s, of a server


class QdrantIndex:
    """Searches rows with Qdrant.

    vectors (rows, d) float32, seeds (rows,), shards: task -> rows. digest: names the server's collection. url: the
    server; None: the engine in this process.

    Raises:
        UsageError: the server does not answer, or refuses.
        StorageError: the engine cannot keep its files.
    """

    def __init__(
        self, vectors: np.ndarray, seeds: np.ndarray, shards: Mapping[str, slice], digest: str, url: str | None = None
    ) -> None:
        self.vectors, self.seeds, self.shards = vectors, seeds, shards
        self.longest = length_of_longest(vectors)
        width = vectors.shape[1]
        if url is None:
            self.engine: EmbeddedEngine | ServerEngine = EmbeddedEngine(width)
            self._fill()
        else:
            server = ServerEngine(url, f"kerv-{digest[:32]}", width)
            self.engine = server
            if server.count() != len(vectors):  # new, or a process ended while it filled it
                self._fill()

    def _fill(self) -> None:
        size = max(1, BATCH // self.vectors.shape[1])
        for task, shard in self.shards.items():
            for first in range(shard.start, shard.stop, size):
                rows = slice(first, min(first + size, shard.stop))
                payloads = [{"task": task, "seed": seed} for seed in self.seeds[rows].tolist()]
                self.engine.put(first, self.vectors[rows], payloads)

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        """Rows that hold the k nearest, increasing, see `Index`. Searches again, with a score bound instead of a
        limit, where rows beyond the limit may tie with the k-th."""
        query, shard = key.tolist(), self.shards[task]
        points = self.engine.search(query, task, k + MARGIN, without, None)
        rows = np.sort(np.array([row for row, _ in points], dtype=np.int64))
        if len(points) < k + MARGIN:
            return rows
        least = float(best(self.vectors, rows, key, k)[1][-1]) - slack(self.longest, key)
        if points[-1][1] < least:
            return rows
        above = least - slack(self.longest, key) - 1e-9  # Qdrant leaves out what scores just as much
        points = self.engine.search(query, task, shard.stop - shard.start, without, above)
        return np.sort(np.array([row for row, _ in points], dtype=np.int64))


def qdrant_index(
    vectors: np.ndarray, seeds: np.ndarray, shards: Mapping[str, slice], digest: str, settings: QdrantSearchSettings
) -> QdrantIndex:
    """datastore=qdrant; errors as `QdrantIndex`, and UsageError where the packages of the extra are not installed."""
    if find_spec("qdrant_client" if settings.url else "qdrant_edge") is None:
        raise UsageError("datastore=qdrant needs the extra: pip install 'kerv[qdrant]'")
    return QdrantIndex(vectors, seeds, shards, digest, settings.url)


class EmbeddedEngine:
    """Qdrant's own engine, one search thread, without a server. Point i is row i of the datastore, with its task and
    seed."""

    def __init__(self, width: int) -> None:
        import qdrant_edge as q

        self.q, folder = q, tempfile.mkdtemp(prefix="kerv-qdrant-")
        vectors = q.EdgeVectorParams(size=width, distance=q.Distance.Dot)
        with _storage_errors(folder):
            # nothing needs to outlive the process, so there is no write-ahead log
            config = q.EdgeConfig(vectors=vectors, wal_enabled=False, max_search_threads=1)
            self.shard = q.EdgeShard.create(folder, config)
            for field, kind in (("task", q.PayloadSchemaType.Keyword), ("seed", q.PayloadSchemaType.Integer)):
                self.shard.update(q.UpdateOperation.create_field_index(field, kind))
        self.folder = folder
        self.close = weakref.finalize(self, _discard, self.shard, folder)

    def put(self, first: int, vectors: np.ndarray, payloads: list[dict[str, str | int]]) -> None:
        """Stores rows first, first + 1, …: vectors (n, d), one payload each."""
        points = [
            self.q.Point(first + i, vector, payload)
            for i, (vector, payload) in enumerate(zip(vectors.tolist(), payloads, strict=True))
        ]
        with _storage_errors(self.folder):
            self.shard.update(self.q.UpdateOperation.upsert_points(points))

    def search(
        self, key: list[float], task: str, limit: int, without: int | None, above: float | None
    ) -> list[tuple[int, float]]:
        """(row, score) of the `limit` best of the task's rows, best first; of those that score more than `above`.
        without: seed passed over."""
        q = self.q
        must = [q.FieldCondition("task", match=q.MatchValue(task))]
        excluded = [] if without is None else [q.FieldCondition("seed", match=q.MatchValue(without))]
        request = q.QueryRequest(
            limit=limit,
            query=q.Query.Nearest(key),
            filter=q.Filter(must=must, must_not=excluded),
            params=q.SearchParams(exact=True),
            score_threshold=above,
            with_payload=False,
        )
        return [(int(point.id), point.score) for point in self.shard.query(request)]


@contextmanager
def _storage_errors(folder: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # the engine raises nothing more particular
        raise StorageError(f"datastore=qdrant cannot keep its vectors in {folder}: {_line(error)}") from error


def _discard(shard: Any, folder: str) -> None:
    shard.close()
    shutil.rmtree(folder, ignore_errors=True)


class ServerEngine:
    """A Qdrant server, with the methods of `EmbeddedEngine`; creates the collection where there is none."""

    def __init__(self, url: str, collection: str, width: int) -> None:
        from qdrant_client import QdrantClient, models

        self.url, self.collection, self.models = url, collection, models
        with self._errors():
            self.client = QdrantClient(url=url, timeout=TIMEOUT, check_compatibility=False)
            if not self.client.collection_exists(collection):
                self._create(width)

    def _create(self, width: int) -> None:
        from qdrant_client.http.exceptions import ApiException

        m = self.models
        vectors = m.VectorParams(size=width, distance=m.Distance.DOT)
        no_graph = m.HnswConfigDiff(m=0)  # the search is exact
        try:
            self.client.create_collection(self.collection, vectors_config=vectors, hnsw_config=no_graph)
        except ApiException:
            if not self.client.collection_exists(self.collection):  # else another process was faster
                raise
        for field, kind in (("task", m.PayloadSchemaType.KEYWORD), ("seed", m.PayloadSchemaType.INTEGER)):
            self.client.create_payload_index(self.collection, field, kind)

    def count(self) -> int:
        """Points in the collection."""
        with self._errors():
            return self.client.count(self.collection, exact=True).count

    def put(self, first: int, vectors: np.ndarray, payloads: list[dict[str, str | int]]) -> None:
        """Stores rows first, first + 1, …: vectors (n, d), one payload each."""
        ids = list(range(first, first + len(vectors)))
        batch = self.models.Batch(ids=ids, vectors=vectors.tolist(), payloads=payloads)
        with self._errors():
            self.client.upsert(self.collection, batch, wait=True)

    def search(
        self, key: list[float], task: str, limit: int, without: int | None, above: float | None
    ) -> list[tuple[int, float]]:
        """(row, score) of the `limit` best of the task's rows, best first; of those that score more than `above`.
        without: seed passed over."""
        m = self.models
        must = [m.FieldCondition(key="task", match=m.MatchValue(value=task))]
        excluded = [] if without is None else [m.FieldCondition(key="seed", match=m.MatchValue(value=without))]
        with self._errors():
            response = self.client.query_points(
                self.collection,
                query=key,
                query_filter=m.Filter(must=must, must_not=excluded),
                search_params=m.SearchParams(exact=True),
                limit=limit,
                score_threshold=above,
                with_payload=False,
            )
        return [(int(point.id), point.score) for point in response.points]

    @contextmanager
    def _errors(self) -> Iterator[None]:
        from httpx import HTTPError, InvalidURL
        from qdrant_client.http.exceptions import ApiException

        try:
            yield
        except (ApiException, HTTPError, InvalidURL, OSError, ValueError) as error:
            raise UsageError(
                f"datastore.url={self.url}: no Qdrant server answers ({_line(error)}); start one, or leave "
                "datastore.url out to search in this process"
            ) from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
