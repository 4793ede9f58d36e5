"""Messages of the policy server: msgpack with numpy arrays, and how openpi's client writes and reads these.

openpi's array is a map with the *bytes* keys __ndarray__ (true), data, dtype, shape; a scalar one with __npgeneric__,
data, dtype. Only plain numbers are accepted: nothing is unpickled, and no array is larger than its own bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import numpy as np

from kerv_cli.base.errors import KervError, UsageError

KINDS = "biuf"  # booleans, integers, floats
Message = Mapping[str, Any]
"""A map that a client sent, as msgpack reads it: nothing in it is checked."""


def packed(value: object) -> bytes:
    """A message of dicts, lists, texts, numbers and numpy arrays, for openpi."""
    return packed_as(value, _plain)


def unpacked(frame: bytes | str) -> Message:
    """A message of openpi's; errors as `read_map`."""
    return read_map(frame, _array)


def packed_as(value: object, plain: Callable[[object], object]) -> bytes:
    """A message. plain: a value that msgpack does not know -> one that it knows."""
    data: bytes = _msgpack().packb(value, default=plain)
    return data


def read_map(frame: bytes | str, special: Callable[[dict[Any, Any]], object]) -> Message:
    """A message that is a map with text keys. special: a map within it -> what it stands for.

    Raises:
        UsageError: it is not one, or holds an array that does not fit its bytes.
    """
    if isinstance(frame, str):
        raise UsageError("a text frame came, messages are binary (msgpack)")
    try:
        value = _msgpack().unpackb(frame, object_hook=special, strict_map_key=True)
    except UsageError:
        raise
    except Exception as error:  # msgpack raises many kinds, which mean the same
        raise UsageError(f"the message cannot be read as msgpack ({type(error).__name__})") from error
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise UsageError(f"the message is a {type(value).__name__}, a map with text keys is wanted")
    return value


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _array(value: dict[Any, Any]) -> object:
    if b"__ndarray__" in value:
        return array_of(value.get(b"dtype"), value.get(b"shape"), value.get(b"data"))
    if b"__npgeneric__" in value:
        return _dtype(value.get(b"dtype")).type(value.get(b"data"))
    return value


def array_of(name: object, shape: object, data: object) -> np.ndarray:
    """The array of that type and shape in these bytes. Raises UsageError: they do not fit together."""
    dtype = _dtype(name)
    if not isinstance(shape, list) or not all(isinstance(n, int) and n >= 0 for n in shape) or len(shape) > 8:
        raise UsageError(f"an array of shape {str(shape)[:60]}: at most 8 whole numbers are wanted")
    if not isinstance(data, bytes) or math.prod(shape) * dtype.itemsize != len(data):
        raise UsageError(f"an array of shape {shape} and type {dtype} does not fit its bytes")
    return np.frombuffer(data, dtype).reshape(shape).copy()  # one that may be written to


def _dtype(name: object) -> np.dtype:
    try:
        dtype = np.dtype(name) if isinstance(name, str) else None
    except TypeError:
        dtype = None
    if dtype is None or dtype.kind not in KINDS:
        raise UsageError(f"an array of type {str(name)[:40]}: booleans, integers and floats are accepted")
    return dtype


def _msgpack() -> ModuleType:
    try:
        import msgpack
    except ImportError as error:
        raise KervError("the policy server needs more packages: pip install 'kerv[serve]'") from error
    return msgpack
