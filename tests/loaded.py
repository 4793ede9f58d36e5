"""Loads what tests need in a special way: programs of scripts/, artifacts for a target."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.methods.heisd.datastore import Datastore, Manifest
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.worlds.metaworld.spec import SPEC


def module_of(path: Path) -> Any:
    """What the file defines, executed anew at every call."""
    spec = importlib.util.spec_from_file_location(f"loaded_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def datastore_of(
    vectors: np.ndarray,
    tokens: np.ndarray,
    shards: dict[str, slice],
    seeds: np.ndarray | None = None,
    left: int = 50,
    space: ActionSpace = SPEC.actions,
) -> Datastore:
    """A datastore in memory; by default row i is of episode i. The steps tell the row."""
    files, rows = {"vectors.npy": "v" * 64, "payload.parquet": "p" * 64}, np.arange(len(vectors))
    manifest = Manifest(
        2, "datastore", ("scene",), vectors.shape[1], len(rows), 4, space, "t" * 64, "d" * 64, files, {}
    )
    columns = vectors.astype(np.float32), tokens.astype(np.uint8), rows if seeds is None else seeds, rows
    return Datastore(manifest, *columns, np.full(len(rows), left), shards)


def of_target(description: TargetDescription, target: object) -> Any:
    """What an artifact is loaded for: stands for `Artifacts`."""
    return SimpleNamespace(description=description, target=target)
