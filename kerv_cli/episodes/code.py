"""Hash of the code that computes an episode. Provenance: it tells which episodes other code computed."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import kerv_cli
from kerv_cli.base.registry import kinds, parts

_COMPUTING = ("base", "engine", "methods", "targets", "worlds", "episodes")
"""Rooms whose code an episode runs."""


@functools.cache
def code_hash() -> str:
    """Return the hex SHA-256 over the names and syntax trees of the files that compute an episode.

    These are kerv's own and those of registered plugins. Comments, docstrings and layout do not count.
    """
    digest = hashlib.sha256()
    for name, path in [*_package(), *_outside()]:
        content = _meaning(path.read_bytes()) if path.suffix == ".py" else path.read_bytes()
        digest.update(f"{name}\0".encode() + hashlib.sha256(content).digest())
    return digest.hexdigest()


def _meaning(source: bytes) -> bytes:
    """Return the syntax tree as text, without docstrings."""
    return ast.dump(_WithoutDocstrings().visit(ast.parse(source))).encode()


class _WithoutDocstrings(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        alone = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if alone else node


def _package() -> Iterator[tuple[str, Path]]:
    root = Path(kerv_cli.__file__).parent
    files = [path for room in _COMPUTING for path in (root / room).rglob("*.py")]
    return ((path.relative_to(root).as_posix(), path) for path in sorted(files))


def _outside() -> Iterator[tuple[str, Path]]:
    computing = [kind for kind in kinds() if kind not in ("executor", "command")]
    modules = {part.build.partition(":")[0] for kind in computing for part in parts(kind).values()}
    for name in sorted(module for module in modules if module and not module.startswith("kerv_cli.")):
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None:
            yield name, Path(spec.origin)
