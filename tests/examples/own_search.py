"""Example: a search of your own through a datastore: it offers every entry of the task, kerv ranks them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kerv_cli.base.registry import NoSettings, add


class Everything:
    """The `Index` protocol of `kerv_cli/methods/heisd/datastore.py`."""

    def __init__(self, seeds: np.ndarray, shards: Mapping[str, slice]) -> None:
        self.seeds, self.shards = seeds, shards

    def candidates(self, key: np.ndarray, task: str, k: int, without: int | None) -> np.ndarray:
        rows = np.arange(len(self.seeds))[self.shards[task]]
        return rows if without is None else rows[self.seeds[rows] != without]


def build(
    vectors: np.ndarray, seeds: np.ndarray, shards: Mapping[str, slice], digest: str, settings: NoSettings
) -> Everything:
    """vectors (rows, d); digest: of the datastore's content."""
    return Everything(seeds, shards)


add("datastore", "everything", f"{__name__}:build")
