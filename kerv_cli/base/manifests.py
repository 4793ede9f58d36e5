"""Reads JSON that describes an artifact into a dataclass, checked field by field."""

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
"""pydantic's name for a field that a dataclass does not have."""


@functools.cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    _forbid_unknown(kind)
    return TypeAdapter(kind)


def _forbid_unknown(kind: Any) -> None:
    """Makes pydantic refuse unknown fields and NaN or infinity in a dataclass and in those that its fields hold."""
    if dataclasses.is_dataclass(kind) and not hasattr(kind, "__pydantic_config__"):
        setattr(kind, "__pydantic_config__", {"extra": "forbid", "allow_inf_nan": False})  # noqa: B010
        for hint in get_type_hints(kind).values():
            _forbid_unknown(hint)
    for inner in get_args(kind):
        _forbid_unknown(inner)


def read(kind: type[T], value: Any, what: str, tolerant: bool = False) -> T:
    """`value` (what JSON gives) as an instance of the dataclass `kind`, nested ones included. tolerant: fields that
    this kerv does not know, e.g. of a newer one, are left out instead of refused.

    Raises:
        CheckpointError: a field is missing, unknown or of another type; the line names the first one.
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
    """The JSON file at `path` as an instance of `kind`; unknown fields are left out.

    Raises:
        CheckpointError: the file is missing, no JSON, or not of this kind.
    """
    return read(kind, read_mapping(path), str(path), tolerant=True)


def content_of(key: Sequence[str], chunk: int, target: str, files: Mapping[str, str]) -> str:
    """Hash by which others name a datastore: over its keys, chunk and target (docs/formats.md)."""
    text = json.dumps([key, chunk, target, sorted(files.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def check_files(folder: Path, files: Mapping[str, str], again: str) -> None:
    """Checks that the files in `folder` are those that its manifest names. files: name -> SHA-256; again: the remedy.

    Raises:
        CheckpointError: one is missing or changed.
    """
    for name, digest in files.items():
        if sha256_of(folder / name) != digest:
            raise CheckpointError(f"{folder / name} does not match its manifest: {again}")
