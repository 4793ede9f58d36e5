"""Read JSON that describes an artifact into a dataclass. Every field is checked."""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
import json
import operator
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.files import read_mapping, sha256_of
from kerv_cli.base.limits import check_settings

T = TypeVar("T")

_UNKNOWN = "unexpected_keyword_argument"
"""Pydantic's name for a field that a dataclass does not have."""


@functools.cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    _forbid_unknown(kind)
    return TypeAdapter(kind)


def _forbid_unknown(kind: Any) -> None:
    """Make pydantic refuse unknown fields, NaN and infinity, in a dataclass and in those that its fields hold."""
    if dataclasses.is_dataclass(kind) and not hasattr(kind, "__pydantic_config__"):
        setattr(kind, "__pydantic_config__", {"extra": "forbid", "allow_inf_nan": False})  # noqa: B010
        for hint in get_type_hints(kind).values():
            _forbid_unknown(hint)
    for inner in get_args(kind):
        _forbid_unknown(inner)


def read(kind: type[T], value: Any, what: str, tolerant: bool = False) -> T:
    """Return plain values as an instance of a dataclass, with the dataclasses inside it.

    Args:
        kind: The dataclass.
        value: Plain values, as JSON has them.
        what: How messages call them.
        tolerant: Leave out unknown fields, such as those of a newer kerv, instead of refusing them.

    Raises:
        CheckpointError: A field is missing, unknown or of another type. The message names the first one.
    """
    from pydantic import ValidationError

    try:
        adapter: Any = _adapter(kind)  # type: ignore[arg-type]
        checked: T = adapter.validate_python(value)
        check_settings(checked)
    except ValidationError as error:
        first = error.errors()[0]
        if tolerant and any(one["type"] == _UNKNOWN for one in error.errors()):
            return read(kind, _without(value, [one["loc"] for one in error.errors() if one["type"] == _UNKNOWN]), what)
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise CheckpointError(f"{what} is damaged: {where}: {first['msg'].lower()}") from error
    except KervError as error:  # what the dataclass itself refuses, and settings out of range
        raise CheckpointError(f"{what} is damaged: {error}") from error
    return checked


def _without(value: Any, fields: list[tuple[int | str, ...]]) -> Any:
    """Return a copy of plain values without these fields, at any depth."""
    value = copy.deepcopy(value)
    for *path, name in fields:
        del functools.reduce(operator.getitem, path, value)[name]
    return value


def read_file(kind: type[T], path: Path) -> T:
    """Return a JSON file as an instance of a dataclass. Unknown fields are left out.

    Raises:
        CheckpointError: The file is missing, not JSON, or does not fit.
    """
    return read(kind, read_mapping(path), str(path), tolerant=True)


def content_of(key: Sequence[str], chunk: int, target: str, files: Mapping[str, str]) -> str:
    """Return the hash by which others name a datastore, over its keys, chunk and target (docs/formats.md)."""
    text = json.dumps([key, chunk, target, sorted(files.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def check_files(folder: Path, files: Mapping[str, str], again: str) -> None:
    """Check that the files in a folder are those that its manifest names.

    Args:
        folder: The folder.
        files: Name -> SHA-256.
        again: What to do if they are not.

    Raises:
        CheckpointError: A file is missing or changed.
    """
    for name, digest in files.items():
        if sha256_of(folder / name) != digest:
            raise CheckpointError(f"{folder / name} does not match its manifest: {again}")
