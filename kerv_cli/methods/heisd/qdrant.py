"""Search the datastore with Qdrant (docs/methods.md §4.1). The extra: pip install 'kerv[qdrant]'.

Qdrant searches exactly within a task. `datastore.best` ranks its results again, so that the neighbours equal those of
exact search. A collection is named by the datastore's hash, so a folder or server keeps it for later processes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.methods.heisd import QdrantSearchSettings
from kerv_cli.methods.heisd.datastore import ROUNDING, best

MARGIN = 8  # rows requested beyond k; if these may tie with the k-th too, all rows of the task are candidates


class QdrantIndex:
    """datastore=qdrant: search by a server, or by the client itself, in a folder or in memory."""

    def __init__(
        self,
        vectors: np.ndarray,
        seeds: np.ndarray,
        shards: Mapping[str, slice],
        digest: str,
        settings: QdrantSearchSettings,
    ) -> None:
        """Open the collection of this datastore, and fill it if it is not complete.

        Args:
            vectors: (rows, d) float32.
            seeds: (rows,) seed of each row's episode.
            shards: Rows of each task.
            digest: Hash of the datastore.
            settings: Server or folder.

        Raises:
            UsageError: qdrant-client is not installed, or the server or folder cannot be used.
        """
        if find_spec("qdrant_client") is None:
            raise UsageError("datastore=qdrant needs the extra: pip install 'kerv[qdrant]'")
        from qdrant_client import QdrantClient, models

        self.vectors, self.seeds, self.shards = vectors, seeds, shards
        self.longest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
        self.models, self.name, self.settings = models, f"kerv-{digest[:32]}", settings
        with self._errors():
            memory = None if settings.url or settings.path else ":memory:"
            self.client = QdrantClient(memory, url=settings.url, path=settings.path, check_compatibility=False)
            if not self.client.collection_exists(self.name):
                parameters = models.VectorParams(size=vectors.shape[1], distance=models.Distance.DOT)
                self.client.create_collection(self.name, parameters)
            if self.client.count(self.name).count != len(vectors):  # new, or filled in part
                tasks = [(task, row) for task, shard in shards.items() for row in range(shard.start, shard.stop)]
                payloads = [{"task": task, "seed": int(seeds[row])} for task, row in tasks]
                rows = [row for _, row in tasks]
                self.client.upload_collection(self.name, vectors[rows], payloads, rows, wait=True)

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        """Return candidate rows, see `Index`."""
        m, shard = self.models, self.shards[task]
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
        slack = 2 * ROUNDING * self.longest * math.sqrt(key @ key)
        if found[-1].score < best(self.vectors, rows, key, k)[1][-1] - slack:
            return rows
        return np.flatnonzero(self.seeds[shard] != without) + shard.start

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # the client raises errors of many libraries
            where = " ".join(f"datastore.{name}={value}" for name, value in vars(self.settings).items() if value)
            raise UsageError(f"{where}: Qdrant cannot search here ({' '.join(str(error).split())})") from error
