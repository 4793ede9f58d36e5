"""Encode and decode websocket messages: msgpack with numpy arrays.

An array is encoded as a map with the keys __ndarray__ (true), data, dtype and shape. These keys are bytes in openpi and
text in vla-eval. In openpi, a single number is a map with the keys __npgeneric__, data and dtype. In vla-eval, an image
is a map with the keys __image__, data and format, and with dtype and shape if the format is raw. Nothing is unpickled.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError

# Largest allowed side of an image, in pixels. It limits PNG and JPEG files, and policies that read any image size.
LARGEST = 4096

# A client's message as msgpack decodes it. Its values have not been checked.
Message = Mapping[str, Any]


def packed(value: object, text_keys: bool = False) -> bytes:
    """Encode a message with msgpack. The keys of an array's map are texts (`text_keys`, vla-eval) or bytes (openpi)."""
    import msgpack

    def plain(value: object) -> object:
        if isinstance(value, np.generic):
            return value.item()
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(value).__name__} cannot be sent")
        array = {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}
        return array if text_keys else {key.encode(): item for key, item in array.items()}

    data: bytes = msgpack.packb(value, default=plain)
    return data


def unpacked(frame: bytes | str) -> Message:
    """Decode a client's message with msgpack. A PNG or JPEG image becomes a function that returns the decoded image."""
    import msgpack

    if isinstance(frame, str):
        raise UsageError("a text message came: send binary messages (msgpack)")
    try:
        value = msgpack.unpackb(frame, object_hook=_value, strict_map_key=True)
    except UsageError:
        raise
    except Exception as error:  # msgpack raises many types of exceptions
        raise UsageError(f"the message cannot be read as msgpack ({type(error).__name__})") from error
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise UsageError(f"the message is a {type(value).__name__}, a map with text keys is wanted")
    return value


def _value(value: dict[Any, Any]) -> object:
    # a PNG or JPEG image becomes a function that decodes it when called, because most images are never used
    items = {key.decode() if isinstance(key, bytes) else key: item for key, item in value.items()}
    data, name = items.get("data"), items.get("dtype")
    if items.get("__image__") and items.get("format") != "raw":
        return functools.partial(_image, data)
    if "__ndarray__" in items or items.get("__image__"):
        return _array(name, items.get("shape"), data)
    if "__npgeneric__" in items:
        return _dtype(name).type(data)
    return value


def _array(name: object, shape: Any, data: Any) -> np.ndarray:
    dtype = _dtype(name)
    try:
        return np.frombuffer(data, dtype).reshape(shape).copy()  # an array over bytes would be read-only
    except (TypeError, ValueError) as error:
        text = str(shape)[:60]
        raise UsageError(f"an array of shape {text} and type {dtype} does not fit its bytes") from error


def _dtype(name: object) -> np.dtype:
    try:
        dtype = np.dtype(name) if isinstance(name, str) else None
    except TypeError:
        dtype = None
    if dtype is None or dtype.kind not in "biuf":
        raise UsageError(f"an array of type {str(name)[:40]}: booleans, integers and floats are accepted")
    return dtype


def _image(data: Any) -> np.ndarray:
    """Decode a PNG or JPEG file to an array, which is (height, width, 3) for a colour image."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if max(image.size) > LARGEST:
                raise UsageError(f"an image of {image.size[0]} x {image.size[1]} pixels: at most {LARGEST} a side")
            return np.array(image)
    except UsageError:
        raise
    except Exception as error:  # Pillow raises many types of exceptions
        raise UsageError(f"an image cannot be read as PNG or JPEG ({type(error).__name__})") from error
