"""Describe what a served policy reads and sends, and check the messages of its clients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.base.wire import LARGEST, Message
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.targets.openvla.config import GRIP
from kerv_cli.worlds.spec import EnvironmentSpec
from kerv_cli.worlds.views import frame_shape

# Client's convention (setting `gripper`) -> number that means an open gripper. The negated number means closed.
OPEN = {"signed": 1.0, "signed_inverted": -1.0}


@dataclass
class Interface:
    """What a policy reads and sends.

    Args:
        gripper: How the gripper's value is sent: `as_is`, `signed` (-1 closed, 1 open) or `signed_inverted` (1 closed,
            -1 open).

    Attributes:
        space: Action space of the environment, or of the policy if kerv does not know the environment.
        size: Side of an image in pixels. 0 if the policy reads no images.
        privileged: Whether the policy reads the whole simulator state, not only proprioception.
        grip: The two gripper values in the environment's actions: first to close, then to open. OpenVLA's if kerv does
            not know the environment.
    """

    description: TargetDescription
    spec: EnvironmentSpec | None
    gripper: str
    images_alone: bool

    def __post_init__(self) -> None:
        policy = self.description
        self.actions, self.observation, self.cameras = policy.actions, policy.observation, policy.cameras
        self.size = int(policy.settings.get("image_size", 0)) if policy.cameras else 0
        self.privileged = not policy.cameras and policy.observation.state > 0
        self.space = self.spec.actions if self.spec else policy.actions
        self.grip = (self.spec.grip if self.spec else ()) or GRIP

    def image(self, image: object, camera: str, key: str) -> np.ndarray:
        """Check a client's image (height, width, 3) uint8, and return it. `image` may be a function that returns it."""
        shape = frame_shape(camera, self.size)
        image = image() if callable(image) else image
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
        """Return the proprioception (p,) and the simulator state (s,) that a client sent.

        A message may leave out numbers that the policy does not read. These numbers are then zero.
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
        """Return the policy's actions (H, D) as float64, environment units, the gripper in the client's convention."""
        values, strict = actions.astype(np.float64), self.actions.is_strict
        if self.gripper in OPEN:
            closed, opened = self.grip
            is_open = (values[:, strict] - (closed + opened) / 2) * (opened - closed) > 0
            values[:, strict] = np.where(is_open, OPEN[self.gripper], -OPEN[self.gripper])
        return values


def keys_of(message: Message) -> str:
    return ", ".join(sorted(str(key)[:40] for key in message)[:8]) or "nothing"


def text_of(value: object, key: str) -> str:
    """Return the instruction that a client sent under `key`. A missing or empty instruction is refused."""
    if not isinstance(value, str | None):
        raise UsageError(f"{key} is {type(value).__name__}, a text is wanted")
    if not value or not value.strip():
        raise UsageError(f"no {key}: the message must say what the robot has to do")
    return value


def hand_of(observation: Observation) -> np.ndarray:
    """Return the position (3,) of the end effector in metres. Coordinates that the observation lacks are zero."""
    hand = np.zeros(3)
    hand[: len(observation.proprioception[:3])] = observation.proprioception[:3]
    return hand
