"""Messages of the policy server: msgpack with numpy arrays.

openpi's array is a map with the *bytes* keys __ndarray__ (true), data, dtype and shape; its scalar one with
__npgeneric__, data and dtype. Only plain numbers are accepted: nothing is unpickled, and no array is larger than its
own bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError

Message = Mapping[str, Any]
"""A map that a client sent, as msgpack reads it. Nothing in it is checked."""


def packed(value: object) -> bytes:
    """Return a message of openpi."""
    return packed_as(value, _openpi_map)


def unpacked(frame: bytes | str) -> Message:
    """Return the content of a message of openpi; raise as `read_map`."""
    return read_map(frame, _openpi_value)


def packed_as(value: object, to_plain: Callable[[object], object]) -> bytes:
    """Return a message of dicts, lists, texts, numbers and what `to_plain` turns into these."""
    import msgpack

    data: bytes = msgpack.packb(value, default=to_plain)
    return data


def read_map(frame: bytes | str, from_map: Callable[[dict[Any, Any]], object]) -> Message:
    """Return the content of a message; `from_map` turns each map within it into what it stands for.

    Raises:
        UsageError: The message is no map with text keys, or holds an array that does not fit its bytes.
    """
    import msgpack

    if isinstance(frame, str):
        raise UsageError("a text frame came, messages are binary (msgpack)")
    try:
        value = msgpack.unpackb(frame, object_hook=from_map, strict_map_key=True)
    except UsageError:
        raise
    except Exception as error:  # msgpack raises many kinds, which mean the same
        raise UsageError(f"the message cannot be read as msgpack ({type(error).__name__})") from error
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise UsageError(f"the message is a {type(value).__name__}, a map with text keys is wanted")
    return value


def array_of(name: object, shape: object, data: object) -> np.ndarray:
    """Return the array of this type and shape in these bytes.

    Raises:
        UsageError: They do not fit together.
    """
    dtype = _dtype(name)
    if not isinstance(shape, list) or not all(isinstance(n, int) and n >= 0 for n in shape) or len(shape) > 8:
        raise UsageError(f"an array of shape {str(shape)[:60]}: at most 8 whole numbers are wanted")
    if not isinstance(data, bytes) or math.prod(shape) * dtype.itemsize != len(data):
        raise UsageError(f"an array of shape {shape} and type {dtype} does not fit its bytes")
    return np.frombuffer(data, dtype).reshape(shape).copy()  # bytes cannot be written to


def _dtype(name: object) -> np.dtype:
    try:
        dtype = np.dtype(name) if isinstance(name, str) else None
    except TypeError:
        dtype = None
    if dtype is None or dtype.kind not in "biuf":
        raise UsageError(f"an array of type {str(name)[:40]}: booleans, integers and floats are accepted")
    return dtype


def _openpi_map(value: object) -> object:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _openpi_value(value: dict[Any, Any]) -> object:
    if b"__ndarray__" in value:
        return array_of(value.get(b"dtype"), value.get(b"shape"), value.get(b"data"))
    if b"__npgeneric__" in value:
        return _dtype(value.get(b"dtype")).type(value.get(b"data"))
    return value
