"""One client's episode: its messages -> observations -> the decoder -> actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ActionSpace, Observation, ObservationSpace
from kerv_cli.base.views import frame_shape
from kerv_cli.engine.decoder import Decoder

STATE, IMAGE, PROMPT, RESET, EXECUTED = "observation/state", "observation/image", "prompt", "reset", "executed"

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
    """The inputs and outputs of a policy. size: pixels of its images, 0 where it sees none. privileged: it reads the
    whole state. images_alone: it reads no state, so that a message may lack it. gripper: one of GRIPPERS. task: name
    for parts whose levels differ between tasks."""

    name: str
    method: str
    actions: ActionSpace
    observation: ObservationSpace
    cameras: tuple[str, ...]
    size: int
    privileged: bool
    gripper: str
    task: str
    images_alone: bool = False

    def metadata(self, chunk: int) -> dict[str, Any]:
        """The first frame that a client gets. chunk: H."""
        return {
            "server": "kerv",
            "policy": self.name,
            "method": self.method,
            "cameras": list(self.cameras),
            "image_size": self.size,
            "state": list(self.observation.proprioception),
            "actions": list(self.actions.names),
            "low": list(self.actions.low),
            "high": list(self.actions.high),
            "control_hz": self.actions.control_hz,
            "chunk": chunk,
            "gripper": self.gripper,
        }

    def observation_of(self, message: Mapping[str, Any]) -> Observation:
        """The observation in a message.

        Raises:
            UsageError: something is missing, of another size or type, or not finite; the line names it.
        """
        prompt = message.get(PROMPT, "")
        if not isinstance(prompt, str):
            raise UsageError(f"{PROMPT} is {type(prompt).__name__}, a text is wanted")
        images = {camera: self._image(message, camera) for camera in self.cameras}
        felt, state = self._numbers(message)
        return Observation(felt, state, prompt, images)

    def _image(self, message: Mapping[str, Any], camera: str) -> np.ndarray:
        keys = [f"observation/{camera}", *([IMAGE] if len(self.cameras) == 1 else [])]
        key = next((key for key in keys if key in message), None)
        if key is None:
            raise UsageError(f"no image: {' or '.join(keys)} is wanted, the message has {_keys(message)}")
        image, shape = message[key], frame_shape(camera, self.size)
        if not isinstance(image, np.ndarray) or image.shape != shape or image.dtype != np.uint8:
            what = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
            raise UsageError(f"{key} is {what}, {shape} uint8 is wanted")
        return image

    def _numbers(self, message: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Proprioception (p,) and state (s,); numbers that the policy does not read are zero."""
        few, many = len(self.observation.proprioception), self.observation.state
        if not many:
            return np.zeros(0), np.zeros(0)
        values = message.get(STATE)
        if values is None and self.images_alone:
            return np.zeros(few), np.zeros(many)
        sizes = [many] if self.privileged else [few, many]
        if not isinstance(values, np.ndarray | list):
            raise UsageError(f"no {STATE}: {sizes[0]} numbers are wanted, the message has {_keys(message)}")
        try:
            numbers = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{STATE} does not hold numbers") from error
        if numbers.ndim != 1 or len(numbers) not in sizes:
            raise UsageError(f"{STATE} has shape {numbers.shape}, {' or '.join(map(str, sizes))} numbers are wanted")
        if not np.isfinite(numbers).all():
            raise UsageError(f"{STATE} holds numbers that are not finite, at {np.flatnonzero(~np.isfinite(numbers))}")
        return numbers[:few], np.concatenate([numbers, np.zeros(many - len(numbers))])

    def converted(self, actions: np.ndarray) -> np.ndarray:
        """actions (H, D), environment units -> float64 with the strict DoFs in the client's convention."""
        values = actions.astype(np.float64)
        strict = self.actions.is_strict
        values[:, strict] = GRIPPERS[self.gripper](values[:, strict])
        return values


def _keys(message: Mapping[str, Any]) -> str:
    return ", ".join(sorted(message)[:8]) or "nothing"


@dataclass
class Session:
    """One connection. last: the actions (H, D) of the last decode, environment units. at: the end effector's position
    (3,) at that decode, metres."""

    interface: Interface
    decoder: Decoder
    last: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    at: np.ndarray = field(default_factory=lambda: np.zeros(3))
    begun: bool = False
    decodes: int = 0

    def answer(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Decodes the observation in a message -> `actions` (H, D), its time and its forwards.

        Raises:
            UsageError: as `Interface.observation_of`, or a wrong `executed`.
        """
        observation = self.interface.observation_of(message)
        hand = np.zeros(3)
        hand[: len(observation.proprioception[:3])] = observation.proprioception[:3]
        executed = self._executed(message)
        if message.get(RESET) or not self.begun:
            self.decoder.reset(self.interface.task, self.decodes, hand)
            self.begun = True
        else:
            for step, action in enumerate(executed, 1):
                self.decoder.observe(action, self.at + (hand - self.at) * step / len(executed))
        record = self.decoder.decode(observation)
        self.last, self.at = record.actions, hand
        self.decodes += 1
        return {
            "actions": self.interface.converted(record.actions),
            "policy_timing": {"infer_ms": 1000 * record.seconds},
            "decode": {"forwards": record.forwards, "tokens": len(record.tokens), "mode": record.mode},
        }

    def _executed(self, message: Mapping[str, Any]) -> np.ndarray:
        """The actions of the last answer that were executed since: all of them, or the first `executed` ones."""
        count = message.get(EXECUTED, len(self.last))
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 0 <= count <= len(self.last):
            raise UsageError(f"{EXECUTED}={str(count)[:40]}: 0 to {len(self.last)} control steps of the last answer")
        return self.last[: int(count)]
