"""Read the JSON file that describes an artifact into a dataclass, and check every field."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.files import read_mapping, sha256_of
from kerv_cli.base.limits import check_settings

T = TypeVar("T")

DIGEST = "digest"  # field of a JSON file with the SHA-256 of all its other fields, sorted by name, as JSON


def read(kind: type[T], value: Any, what: str, tolerant: bool = False) -> T:
    """Convert a JSON value to a dataclass, whose fields may be dataclasses, too. `what` names the value in errors.

    An unknown field is an error. With `tolerant` it is ignored, because a newer version of kerv may have written it.
    """
    try:
        checked: T = _converted(kind, value, "", tolerant)
        check_settings(checked)
    except KervError as error:  # from the dataclass's own checks, or from check_settings
        raise CheckpointError(f"{what} is damaged: {error}") from error
    return checked


def _converted(kind: Any, value: Any, place: str, tolerant: bool) -> Any:
    # `place` is the keys that lead to the value, such as "tasks.reach-v3."
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any or (value is None and NoneType in args) or type(value) is kind:
        if kind is float and not math.isfinite(value):
            raise KervError(f"{place[:-1]}: {value} is not finite")
        return value
    if kind is float and type(value) is int:
        return float(value)
    if origin is UnionType:
        return _converted(next(one for one in args if one is not NoneType), value, place, tolerant)
    if origin is Literal and value in args:
        return value
    if isinstance(value, Mapping):
        if is_dataclass(kind):
            return _instance(kind, value, place, tolerant)
        if origin in (dict, Mapping):
            return {key: _converted(args[1], one, f"{place}{key}.", tolerant) for key, one in value.items()}
    if isinstance(value, list | tuple) and origin in (list, tuple):
        kinds = args if origin is tuple and args[-1] is not Ellipsis else args[:1] * len(value)
        if len(kinds) == len(value):
            every = enumerate(zip(kinds, value, strict=True))
            return origin(_converted(one, item, f"{place}{i}.", tolerant) for i, (one, item) in every)
    raise KervError(f"{place[:-1]}: {str(value)[:40]!r} is no {getattr(kind, '__name__', kind)}".removeprefix(": "))


def _instance(kind: Any, value: Mapping[str, Any], place: str, tolerant: bool) -> Any:
    hints, given = _hints(kind), dict[str, Any]()
    for at in fields(kind):
        if at.name in value:
            given[at.name] = _converted(hints[at.name], value[at.name], f"{place}{at.name}.", tolerant)
        elif at.default is MISSING and at.default_factory is MISSING:
            raise KervError(f"{place}{at.name}: field required")
    for name in value.keys() - given.keys() if not tolerant else ():
        raise KervError(f"{place}{name}: unknown field")
    try:
        return kind(**given)
    except (KervError, ValueError) as error:
        raise KervError(f"{place[:-1]}: {error}".removeprefix(": ")) from error


_hints = functools.cache(get_type_hints)


def read_file(kind: type[T], path: Path) -> T:
    value = read_mapping(path)
    digest = value.pop(DIGEST, None)  # files of before version 1.1 have none
    if digest is not None and digest != _digest_of(value):
        raise CheckpointError(f"{path} is damaged: its content does not have the hash that it names")
    return read(kind, value, str(path), tolerant=True)


def stamped(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {**fields, DIGEST: _digest_of(fields)}


def _digest_of(fields: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def content_of(key: Sequence[str], chunk: int, target: str, files: Mapping[str, str]) -> str:
    """Return a SHA-256 over everything that determines what a search in a datastore finds (docs/formats.md).

    `key` names the parts of the prompt that make the search key. `chunk` is the number of control steps per chunk.
    `target` and the values of `files` are hashes.
    """
    text = json.dumps([key, chunk, target, sorted(files.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def check_files(folder: Path, files: Mapping[str, str], again: str) -> None:
    """Check that the files in a folder still have their SHA-256. `again` ends the error: how to make them anew."""
    for name, digest in files.items():
        if sha256_of(folder / name) != digest:
            raise CheckpointError(f"{folder / name} does not match its manifest: {again}")
