"""Example: a search of your own through a datastore: it offers every entry of the task, kerv ranks them."""

from __future__ import annotations

import numpy as np

from kerv_cli.base.registry import SearchPart
from kerv_cli.methods.heisd import Index


@SearchPart("everything")
class Everything(Index):
    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        rows = np.arange(len(self.store.seeds))[self.store.shards[task]]
        return rows if without is None else rows[self.store.seeds[rows] != without]
