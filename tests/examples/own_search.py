"""Example: a search of your own through a datastore: it offers every entry of the task, kerv ranks them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.registry import NoSettings, SearchPart
from kerv_cli.methods.heisd import Index

if TYPE_CHECKING:
    from kerv_cli.methods.heisd.datastore import Datastore


@SearchPart("everything")
class Everything(Index):
    def __init__(self, store: Datastore, settings: NoSettings) -> None:
        self.seeds, self.shards = store.seeds, store.shards

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        rows = np.arange(len(self.seeds))[self.shards[task]]
        return rows if without is None else rows[self.seeds[rows] != without]
