"""Example: a search of your own through a datastore: it offers every entry of the task, kerv ranks them."""

from __future__ import annotations

import numpy as np

from kerv_cli.base.registry import NoSettings, add
from kerv_cli.methods.heisd.datastore import Datastore


class Everything:
    """The `Index` protocol of `kerv_cli/methods/heisd/datastore.py`."""

    def __init__(self, store: Datastore, settings: NoSettings) -> None:
        self.seeds, self.shards = store.seeds, store.shards

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        rows = np.arange(len(self.seeds))[self.shards[task]]
        return rows if without is None else rows[self.seeds[rows] != without]


add("datastore", "everything", f"{__name__}:Everything")
