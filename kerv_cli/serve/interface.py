"""The inputs and outputs of a served policy, its messages (msgpack with numpy arrays), and the checks of both.

openpi's array is a map with the *bytes* keys __ndarray__ (true), data, dtype and shape; its scalar one with
__npgeneric__, data and dtype. Only plain numbers are accepted: nothing is unpickled, and no array is larger than its
own bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ActionSpace, Observation, ObservationSpace
from kerv_cli.worlds.views import frame_shape

LARGEST = 4096
"""Pixels of an image's longest side, for a policy that resizes images itself."""
OPEN = {"signed": 1.0, "signed_inverted": -1.0}
"""Number that an open gripper is sent as; a closed one is its negative. LIBERO's simulator expects it inverted."""


@dataclass(frozen=True)
class Interface:
    """What a policy reads and sends.

    Attributes:
        actions: The policy's action space.
        space: The environment's action space; the policy's if kerv has no such environment.
        observation: The policy's observation space.
        cameras: Images it reads.
        size: Pixels of an image; 0 if it sees none.
        privileged: Whether it reads the whole state.
        images_alone: Whether it reads images of any size and no state, so that a message may lack the state.
        gripper: How strict DoFs (a gripper: 0 closed to 1 open) are sent: `as_is`, or as in OPEN.
        grip: The environment's actions that close and that open the gripper; empty if unknown.
    """

    actions: ActionSpace
    space: ActionSpace
    observation: ObservationSpace
    cameras: tuple[str, ...]
    size: int
    privileged: bool
    images_alone: bool
    gripper: str
    grip: tuple[float, ...]

    def image(self, image: object, camera: str, key: str) -> np.ndarray:
        """Check the image (h, w, 3) uint8 of a camera; `key` is its name in messages.

        Raises:
            UsageError: It has another size or type.
        """
        shape = frame_shape(camera, self.size)
        if isinstance(image, np.ndarray):
            fits = image.shape == shape
            if self.images_alone:
                sides = image.shape[:2]
                fits = image.ndim == 3 and image.shape[2] == 3 and min(sides) >= 2 and max(sides) <= LARGEST
            if fits and image.dtype == np.uint8:
                return image
        came = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        wanted = "(height, width, 3)" if self.images_alone else str(shape)
        raise UsageError(f"{key} is {came}, {wanted} uint8 is wanted")

    def numbers(self, values: object, key: str, message: Message) -> tuple[np.ndarray, np.ndarray]:
        """Return proprioception (p,) and state (s,) from the `values` under `key` of a message.

        Numbers that the policy does not read are zero.

        Raises:
            UsageError: They are missing, too few, too many or not finite.
        """
        few, many = len(self.observation.proprioception), self.observation.state
        if not many or (values is None and self.images_alone):
            return np.zeros(few if many else 0), np.zeros(many)
        sizes = [many] if self.privileged else [few, many]
        if not isinstance(values, np.ndarray | list):
            raise UsageError(f"no {key}: {sizes[0]} numbers are wanted, the message has {keys_of(message)}")
        try:
            numbers = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{key} does not hold numbers") from error
        if numbers.ndim != 1 or len(numbers) not in sizes:
            raise UsageError(f"{key} has shape {numbers.shape}, {' or '.join(map(str, sizes))} numbers are wanted")
        if not np.isfinite(numbers).all():
            raise UsageError(f"{key} holds numbers that are not finite, at {np.flatnonzero(~np.isfinite(numbers))}")
        return numbers[:few], np.concatenate([numbers, np.zeros(many - len(numbers))])

    def converted(self, actions: np.ndarray) -> np.ndarray:
        """Return actions (H, D), environment units, as float64 with the client's convention of the gripper."""
        values, strict = actions.astype(np.float64), self.actions.is_strict
        if self.gripper in OPEN:
            values[:, strict] = np.where(values[:, strict] > 0.5, OPEN[self.gripper], -OPEN[self.gripper])
        return values


def keys_of(message: Message) -> str:
    """Return the first keys of a message, for an error."""
    return ", ".join(sorted(str(key)[:40] for key in message)[:8]) or "nothing"


def text_of(value: object, key: str) -> str:
    """Return a text of a message; raise UsageError if it is none."""
    if not isinstance(value, str):
        raise UsageError(f"{key} is {type(value).__name__}, a text is wanted")
    return value


def hand_of(observation: Observation) -> np.ndarray:
    """Return the end effector's position (3,), metres; zeros if the observation does not have it."""
    hand = np.zeros(3)
    hand[: len(observation.proprioception[:3])] = observation.proprioception[:3]
    return hand


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
