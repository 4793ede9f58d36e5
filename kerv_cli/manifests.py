"""Reads JSON that describes an artifact into a dataclass, checked field by field."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from kerv_cli.errors import CheckpointError, KervError
from kerv_cli.files import read_json, sha256_of
from kerv_cli.limits import check_settings

T = TypeVar("T")


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


def read(kind: type[T], value: Any, what: str) -> T:
    """`value` (what JSON gives) as an instance of the dataclass `kind`, nested ones included.

    Raises:
        CheckpointError: a field is missing, unknown or of another type; the line names the first one.
    """
    from pydantic import ValidationError

    try:
        adapter: Any = _adapter(kind)  # type: ignore[arg-type]
        checked: T = adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise CheckpointError(f"{what} is damaged: {where}: {first['msg'].lower()}") from error
        check_settings(checked)
    except KervError as error:  # what the dataclass itself refuses, and settings out of range
        raise CheckpointError(f"{what} is damaged: {error}") from error
    return checked


def read_file(kind: type[T], path: Path, what: str) -> T:
    """The JSON file at `path` as an instance of `kind`; errors as `read`, and a missing or unreadable file."""
    value = read_json(path)
    if not isinstance(value, Mapping):
        raise CheckpointError(f"{path} is not {what}")
    return read(kind, value, str(path))


def check_files(folder: Path, files: Mapping[str, str], again: str) -> None:
    """Checks that the files in `folder` are those that its manifest names. files: name -> SHA-256; again: the remedy.

    Raises:
        CheckpointError: one is missing or changed.
    """
    for name, digest in files.items():
        if sha256_of(folder / name) != digest:
            raise CheckpointError(f"{folder / name} does not match its manifest: {again}")
