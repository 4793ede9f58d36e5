"""The episodes that `kerv calibrate risk` has recorded: a file each, so that an interrupted run continues."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from kerv_cli.base.files import atomic_path

Row = dict[str, Any]
FOLDER = "records"
"""Below the recording's folder, until that is replaced by the complete recording."""
_PLAIN = ("source", "index", "loss")


class RiskRecords:
    """The recorded episodes of one run.

    folder: of the recording. identity: everything that determines an episode's rows besides its task and seed; the
    episodes of another identity lie in another folder. sources, scores: names of the sources of drafts and of the
    scores.
    """

    def __init__(
        self, folder: Path, identity: Mapping[str, Any], sources: Sequence[str], scores: Sequence[str]
    ) -> None:
        text = json.dumps(identity, sort_keys=True)
        self.folder = folder / FOLDER / hashlib.sha256(text.encode()).hexdigest()[:16]
        self.sources, self.scores = list(sources), list(scores)

    def write(self, task: str, seed: int, rows: Sequence[Row], features: Sequence[np.ndarray]) -> None:
        """Writes an episode atomically. rows: of the recording. features: (F,) float16 each.

        Raises:
            StorageError: writing failed.
        """
        tensors: dict[str, np.ndarray] = {
            "source": np.array([self.sources.index(row["source"]) for row in rows], dtype=np.int64),
            "index": np.array([row["index"] for row in rows], dtype=np.int64),
            "loss": np.array([row["loss"] for row in rows], dtype=np.float64),
            **{name: np.array([row[name] for row in rows], dtype=np.float64) for name in self._columns()},
            "features": np.array(features, dtype=np.float16).reshape(len(features), -1 if len(features) else 0),
        }
        with atomic_path(self._path(task, seed)) as temporary:
            temporary.write_bytes(save(tensors, {"sha256": _digest(tensors)}))

    def read(self, task: str, seed: int) -> tuple[list[Row], list[np.ndarray]] | None:
        """Rows and features of an episode; None where it was not recorded, or its file is damaged."""
        try:
            with safe_open(self._path(task, seed), "numpy") as file:
                tensors = {name: file.get_tensor(name) for name in (*_PLAIN, *self._columns(), "features")}
                intact = (file.metadata() or {}).get("sha256") == _digest(tensors)
        except (OSError, SafetensorError, ValueError):
            return None
        if not intact:
            return None
        episode, columns = {"task": task, "seed": seed}, ("index", "loss", *self._columns())
        rows = [
            {"source": self.sources[number], **episode, **{name: tensors[name][at].item() for name in columns}}
            for at, number in enumerate(tensors["source"])
        ]
        return rows, list(tensors["features"])

    def missing(self, task: str, seeds: Sequence[int]) -> list[int]:
        """The seeds among `seeds` whose episode is not recorded."""
        return [seed for seed in seeds if self.read(task, seed) is None]

    def _columns(self) -> list[str]:
        return [f"score.{name}" for name in self.scores]

    def _path(self, task: str, seed: int) -> Path:
        return self.folder / task / f"{seed:06d}.safetensors"


def _digest(tensors: Mapping[str, np.ndarray]) -> str:
    """Hex SHA-256 over names, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(f"{name} {tensors[name].dtype} {tensors[name].shape}".encode() + tensors[name].tobytes())
    return digest.hexdigest()
