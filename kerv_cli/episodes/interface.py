"""How an observation becomes a message to a policy's server, and the answer becomes actions (docs/remote.md)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from kerv_cli.base import manifests
from kerv_cli.base.config import preset_file
from kerv_cli.base.errors import CheckpointError, EpisodeError, UsageError
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.base.limits import check_settings, choice, number, setting
from kerv_cli.base.spaces import Observation
from kerv_cli.base.wire import LARGEST, Message
from kerv_cli.worlds.settings import WorldSettings
from kerv_cli.worlds.spec import EnvironmentSpec

# Gripper convention -> the middle of its values, and 1 if larger values open the gripper, else -1.
OPEN = {"unit": (0.5, 1.0), "signed": (0.0, 1.0), "signed_inverted": (0.0, -1.0)}
STATE = "state"


@dataclass(frozen=True)
class Picture:
    """An image of the message. `camera` may join several views, see `worlds.views`."""

    camera: str
    size: int = number(0, 0, LARGEST, help="pixels of a side; 0: as the simulator draws it")
    mirror: bool = False
    resize: str = choice("bilinear", "bilinear", "lanczos")

    def of(self, image: np.ndarray) -> np.ndarray:
        image = image[:, ::-1] if self.mirror else image
        if not self.size or image.shape[0] == self.size:
            return np.ascontiguousarray(image)
        from PIL import Image, ImageOps

        method = Image.Resampling[self.resize.upper()]
        return np.asarray(ImageOps.pad(Image.fromarray(image), (self.size, self.size), method))


@dataclass(frozen=True)
class Interface:
    """What a server reads and sends. `images` and `state` have an entry per key of the message (docs/remote.md)."""

    environment: str = setting("", "environment that the policy was made for; empty: any")
    pixels: int = number(0, 0, LARGEST, help="pixels that the simulator draws; 0: world.camera.size")
    images: dict[str, Picture] = field(default_factory=dict)
    state: dict[str, list[str]] = field(default_factory=dict)
    prompt: str = setting("prompt", "key of the instruction")
    actions: str = setting("actions", "key of the answer's actions")
    names: list[str] = setting([], "DoFs of an action, in order; empty: the environment's")
    scale: list[float] = setting([], "factor of each DoF; empty: 1")
    gripper: str = choice("as_is", "as_is", *OPEN, help="convention of the strict DoFs")
    execute: int = number(0, 0, 1024, help="actions of an answer that are executed; 0: all")
    kerv: bool = setting(False, "whether the server's metadata says all of this")

    def adapted(self, metadata: Message, execute: int = 0) -> Interface:
        """Return a copy with `execute`, unless it is 0, and with what a kerv server says in its `metadata`."""
        own = replace(self, execute=execute or self.execute)
        if not self.kerv:
            return own
        try:
            images = {f"observation/{one}": Picture(one, int(metadata["image_size"])) for one in metadata["cameras"]}
            state = list(metadata[STATE]) if images else [STATE]
            names, gripper = list(metadata["actions"]), str(metadata["gripper"])
        except (KeyError, TypeError, ValueError):
            raise UsageError(
                "the server is not kerv's, for its metadata names no cameras, state and actions: choose "
                "policy.interface=openpi_libero, or write one (docs/remote.md)"
            ) from None
        return replace(own, images=images, state={"observation/state": state}, names=names, gripper=gripper)

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(one.camera for one in self.images.values()))

    def check(self, spec: EnvironmentSpec, world: WorldSettings) -> None:
        """Refuse an environment that lacks what the server reads, or has other DoFs than the server's actions."""
        if self.environment not in ("", spec.name):
            raise UsageError(f"the server's policy is for {self.environment}, these tasks are of {spec.name}", "task")
        for picture in self.images.values():
            spec.camera_name(picture.camera)
            if self.kerv and picture.size not in (0, world.camera.size):
                raise UsageError(f"the server wants images of {picture.size} pixels: world.camera.size={picture.size}")
        if sorted(self.names or spec.actions.names) != sorted(spec.actions.names):
            raise UsageError(f"the server moves {', '.join(self.names)}, {spec.name} {', '.join(spec.actions.names)}")
        if self.scale and len(self.scale) != spec.actions.dofs:
            raise UsageError(f"scale has {len(self.scale)} numbers, an action of {spec.name} {spec.actions.dofs}")
        if self.gripper in OPEN and not spec.grip:
            raise UsageError(f"gripper={self.gripper}: {spec.name} has no gripper, write as_is")

    def message(self, spec: EnvironmentSpec, observation: Observation) -> dict[str, Any]:
        message: dict[str, Any] = {key: one.of(observation.images[one.camera]) for key, one in self.images.items()}
        own = dict(zip(spec.observation.proprioception, observation.proprioception, strict=True))
        offered = {**own, **observation.readings, STATE: observation.state}
        for key, names in self.state.items():
            if missing := [name for name in names if name not in offered]:
                raise UsageError(f"{spec.name} measures no {missing[0]} for {key}: it has {', '.join(offered)}")
            message[key] = np.concatenate([np.zeros(0), *(np.atleast_1d(offered[name]) for name in names)])
        return {**message, self.prompt: observation.instruction}

    def actions_of(self, spec: EnvironmentSpec, answer: Message) -> tuple[np.ndarray, int]:
        """Return the actions to execute (h, D), float32, environment units, and how many actions the server sent."""
        names, values = self.names or list(spec.actions.names), answer.get(self.actions)
        try:
            sent = np.asarray(values, np.float64)
        except (TypeError, ValueError):
            raise EpisodeError(f"{self.actions} is {type(values).__name__}, numbers are wanted") from None
        sent = sent[None] if sent.ndim == 1 else sent
        if sent.ndim != 2 or sent.shape[1] != len(names) or not len(sent):
            what = f"has shape {sent.shape}" if self.actions in answer else f"is not there ({', '.join(answer)[:200]})"
            raise EpisodeError(f"{self.actions} {what}, (steps, {len(names)}) is wanted")
        if not np.isfinite(sent).all():
            raise EpisodeError(f"{self.actions} holds numbers that are not finite")
        actions = sent[: self.execute or None] * (self.scale or 1.0)
        actions = actions[:, [names.index(name) for name in spec.actions.names]]
        if self.gripper in OPEN:
            (middle, sign), (closed, opened) = OPEN[self.gripper], spec.grip  # type: ignore[misc]
            strict = spec.actions.is_strict
            actions[:, strict] = np.where((actions[:, strict] - middle) * sign > 0, opened, closed)
        return actions.astype(np.float32), len(sent)


def read_interface(name: str) -> Interface:
    path = preset_file("interface", name)
    content, _ = read_yaml_lines(path, f"policy.interface={name}")
    try:
        interface = manifests.read(Interface, content, str(path))
        for key, picture in interface.images.items():
            check_settings(picture, f"images.{key}")
    except (CheckpointError, UsageError) as error:
        raise UsageError(f"policy.interface={name}: {error}", "policy.interface") from error
    return interface
