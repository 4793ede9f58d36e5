"""Which code computes a cell: a hash of its source, so that what older code computed is not reused silently."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import kerv_cli
from kerv_cli.registry import kinds, parts

_COMPUTING = ("decoding", "drafting", "targets", "environments", "rollouts")
"""Packages whose code an episode runs, besides the top-level modules. Not how it is shown, stored or reported."""


@functools.cache
def code_hash() -> str:
    """Hex SHA-256 over the names and contents of the files that compute an episode: kerv's own, and those of parts
    that are registered from outside. Read once per process."""
    digest = hashlib.sha256()
    for name, path in [*_own(), *_outside()]:
        digest.update(f"{name}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _own() -> Iterator[tuple[str, Path]]:
    root = Path(kerv_cli.__file__).parent
    files = [*root.glob("*.py"), *(path for package in _COMPUTING for path in (root / package).rglob("*.py"))]
    return ((path.relative_to(root).as_posix(), path) for path in sorted(files))


def _outside() -> Iterator[tuple[str, Path]]:
    named = {part.build.partition(":")[0] for kind in kinds() for part in parts(kind).values() if kind != "executor"}
    for name in sorted(module for module in named if module and not module.startswith("kerv_cli.")):
        found = importlib.util.find_spec(name)
        if found is not None and found.origin is not None:
            yield name, Path(found.origin)
