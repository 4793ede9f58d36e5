"""The interface of a served policy, and a client's episodes with a decoder of their own; both know no protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ActionSpace, Observation, ObservationSpace
from kerv_cli.base.views import frame_shape
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.episodes.episode import Follower
from kerv_cli.serve.guard import StateRange
from kerv_cli.serve.wire import Message

LARGEST = 4096
"""Pixels of an image's longest side, where the policy resizes images itself."""

Gripper = Callable[[np.ndarray], np.ndarray]
GRIPPERS: Mapping[str, Gripper] = {
    "as_is": lambda values: values,
    "signed": lambda values: np.where(values > 0.5, 1.0, -1.0),
    "signed_inverted": lambda values: np.where(values > 0.5, -1.0, 1.0),
}
"""How the strict DoFs (a gripper: 0 closed to 1 open) are sent: as they are, or −1 closed and 1 open, or the reverse,
which LIBERO's simulator expects."""


@dataclass(frozen=True)
class Interface:
    """The inputs and outputs of a policy.

    environment: its name, "none" where kerv has no such one. space: the environment's action space, else the policy's.
    size: pixels of its images, 0 where it sees none. privileged: it reads the whole state. images_alone: it reads
    images of any size and no state, so that a message may lack it. gripper: one of GRIPPERS. grip: the environment's
    actions of the strict DoFs that close and that open, empty where they are unknown. task: name for parts whose
    levels differ between tasks; empty: the client's.
    """

    name: str
    method: str
    environment: str
    actions: ActionSpace
    space: ActionSpace
    observation: ObservationSpace
    cameras: tuple[str, ...]
    size: int
    privileged: bool
    gripper: str
    grip: tuple[float, ...]
    task: str
    images_alone: bool

    def image(self, image: object, camera: str, key: str) -> np.ndarray:
        """The image (h, w, 3) uint8 of a camera. key: its name in messages.

        Raises:
            UsageError: it is of another size or type.
        """
        wanted = "(height, width, 3)" if self.images_alone else str(frame_shape(camera, self.size))
        if not isinstance(image, np.ndarray):
            raise UsageError(f"{key} is {type(image).__name__}, {wanted} uint8 is wanted")
        fits = image.shape == frame_shape(camera, self.size)
        if self.images_alone:
            fits = (
                image.ndim == 3 and image.shape[2] == 3 and 2 <= min(image.shape[:2]) <= max(image.shape[:2]) <= LARGEST
            )
        if not fits or image.dtype != np.uint8:
            raise UsageError(f"{key} is {image.shape} {image.dtype}, {wanted} uint8 is wanted")
        return image

    def numbers(self, values: object, key: str, message: Message) -> tuple[np.ndarray, np.ndarray]:
        """Proprioception (p,) and state (s,) from the values under `key` of a message, None where it lacks them.
        Numbers that the policy does not read are zero.

        Raises:
            UsageError: they are missing, too few, too many or not finite.
        """
        few, many = len(self.observation.proprioception), self.observation.state
        if not many:
            return np.zeros(0), np.zeros(0)
        if values is None and self.images_alone:
            return np.zeros(few), np.zeros(many)
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
        """actions (H, D), environment units -> float64 with the strict DoFs in the client's convention."""
        values = actions.astype(np.float64)
        strict = self.actions.is_strict
        values[:, strict] = GRIPPERS[self.gripper](values[:, strict])
        return values


def keys_of(message: Message) -> str:
    """The first keys of a message, for an error."""
    return ", ".join(sorted(str(key)[:40] for key in message)[:8]) or "nothing"


def text_of(value: object, key: str) -> str:
    """A text of a message. Raises UsageError: it is none."""
    if not isinstance(value, str):
        raise UsageError(f"{key} is {type(value).__name__}, a text is wanted")
    return value


def hand_of(observation: Observation) -> np.ndarray:
    """The end effector's position (3,), metres; zeros where the observation does not say."""
    hand = np.zeros(3)
    hand[: len(observation.proprioception[:3])] = observation.proprioception[:3]
    return hand


class Session:
    """The episodes of one client.

    decoder: None before the first episode where it depends on the task. range: of the states that the policy may act
    on; None: on all. holds: whether out of it the last action is executed once more, in place of an error. say: writes
    into the log.
    """

    def __init__(
        self,
        decoder: Callable[[str], Follower],
        task: str = "",
        by_task: bool = False,
        range: StateRange | None = None,
        holds: bool = False,
        decode: Callable[[Any, Observation], DecodeRecord] = lambda decoder, observation: decoder.decode(observation),
    ) -> None:
        """decoder: makes the decoder of a task. task: of every episode; empty: the client names it. by_task: a new task
        needs a new decoder. decode: (decoder, observation) -> record."""
        self._make, self._by_task, self.task = decoder, by_task, task
        self.decoder: Any = None if by_task else decoder(task)
        self.range, self.holds, self._decode = range, holds, decode
        self.say: Callable[[str], None] = lambda line: None

    def begin(self, task: str, seed: int, hand: np.ndarray) -> None:
        """An episode of a task begins with the end effector at (3,) metres. Raises CheckpointError: the method has no
        levels for the task."""
        if self._by_task and (self.decoder is None or task != self.task):
            self.decoder, self.task = self._make(task), task
        self.decoder.reset(self.task or task, seed, hand)

    def is_held(self, observation: Observation, has_last: bool) -> bool:
        """Whether the last action is to be executed again, because the policy may not act on this state. has_last:
        whether there is one, of this episode.

        Raises:
            UsageError: it may not, and errors are wanted, or there is no last action.
        """
        why = self.range.outside(observation) if self.range is not None else ""
        if why and not (self.holds and has_last):
            raise UsageError(why)
        if why:
            self.say(f"{why}: the last action is held")
        return bool(why)

    def decode(self, observation: Observation) -> DecodeRecord:
        """The actions for an observation, and their record."""
        return self._decode(self.decoder, observation)
