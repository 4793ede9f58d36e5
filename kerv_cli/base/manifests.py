"""Read the JSON file that describes an artifact into a dataclass, and check every field."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.files import read_mapping, sha256_of
from kerv_cli.base.limits import check_settings

T = TypeVar("T")

DIGEST = "digest"
"""Field of a JSON file with the SHA-256 of all its other fields, sorted by name, as compact JSON."""


@functools.cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    # pydantic applies it to the dataclasses inside, too
    setattr(kind, "__pydantic_config__", {"allow_inf_nan": False})  # noqa: B010
    return TypeAdapter(kind)


def read(kind: type[T], value: Any, what: str, tolerant: bool = False) -> T:
    """Convert a JSON value to a dataclass, whose fields may be dataclasses, too.

    Args:
        kind: The dataclass.
        value: The JSON value.
        what: Name of the value in the error message, such as its file.
        tolerant: Whether to ignore unknown fields, which a newer version of kerv may have written. Otherwise they are
            an error.

    Raises:
        CheckpointError: A field is missing, unknown, of a wrong type or out of range. The message names the first such
            field.
    """
    from pydantic import ValidationError

    try:
        adapter: Any = _adapter(kind)  # type: ignore[arg-type]
        checked: T = adapter.validate_python(value, extra="ignore" if tolerant else "forbid")
        check_settings(checked)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise CheckpointError(f"{what} is damaged: {where}: {first['msg'].lower()}") from error
    except KervError as error:  # from the dataclass's own checks, or from check_settings
        raise CheckpointError(f"{what} is damaged: {error}") from error
    return checked


def read_file(kind: type[T], path: Path) -> T:
    """Read a JSON file into a dataclass. Unknown fields are ignored.

    Raises:
        CheckpointError: The file is missing or not JSON, its content has another hash than it names, or a field is
            missing, of a wrong type or out of range.
    """
    value = read_mapping(path)
    digest = value.pop(DIGEST, None)  # files of before version 1.1 have none
    if digest is not None and digest != _digest_of(value):
        raise CheckpointError(f"{path} is damaged: its content does not have the hash that it names")
    return read(kind, value, str(path), tolerant=True)


def stamped(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a JSON file with a hash of all of them, which `read_file` checks."""
    return {**fields, DIGEST: _digest_of(fields)}


def _digest_of(fields: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def content_of(key: Sequence[str], chunk: int, target: str, files: Mapping[str, str]) -> str:
    """Return the hexadecimal SHA-256 of the four arguments. They determine what a datastore finds (docs/formats.md).

    Args:
        key: Parts of the prompt that form the search keys.
        chunk: H, control steps per stored chunk.
        target: Hash of the target's weights.
        files: Hashes of the datastore's files, by name.
    """
    text = json.dumps([key, chunk, target, sorted(files.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def check_files(folder: Path, files: Mapping[str, str], again: str) -> None:
    """Check that the files in a folder have the hashes that the folder's manifest names.

    Args:
        folder: The folder.
        files: SHA-256 of each file, by name.
        again: What the user should do if a file has changed, text for the error message.

    Raises:
        CheckpointError: A file is missing or changed.
    """
    for name, digest in files.items():
        if sha256_of(folder / name) != digest:
            raise CheckpointError(f"{folder / name} does not match its manifest: {again}")
