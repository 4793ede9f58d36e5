"""vla-eval's protocol, version 1: a harness runs a benchmark and asks for an action at every control step.

A message is a msgpack map of type, payload, seq and timestamp: hello, episode_start, observation, action, episode_end,
error. Hello is answered by what the policy reads and sends (`dim_specs`); an observation by one action, of a chunk that
is decoded when the one before is used up. The package vla-eval is not needed here.
"""

from __future__ import annotations

import functools
import io
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.places import results_dir
from kerv_cli.base.spaces import Observation
from kerv_cli.catalogue.served import path_of, write_served
from kerv_cli.engine.record import DecodeRecord, EpisodeRecord
from kerv_cli.serve.policy import Policy
from kerv_cli.serve.server import Conversation, Reply
from kerv_cli.serve.session import LARGEST, Interface, Session, hand_of, keys_of, text_of
from kerv_cli.serve.wire import Message, array_of, packed_as, read_map

VERSION = 1
"""Of the protocol."""
_FORMATS = {("position", 3): "delta_xyz", ("rotation", 3): "axis_angle"}
"""Name and size of a group of DoFs -> how vla-eval calls its format."""


def dim_specs(interface: Interface) -> dict[str, dict[str, dict[str, object]]]:
    """What the policy sends (`action_spec`) and reads (`observation_spec`), as vla-eval's DimSpecs."""
    actions: dict[str, dict[str, object]] = {}
    low, high = interface.converted(np.array([interface.actions.low, interface.actions.high]))
    for group in interface.actions.groups:
        part = interface.actions.dofs_of(group.name)
        strict = bool(interface.actions.is_strict[part].all())
        form = _gripper_format(interface) if strict else _FORMATS.get((group.name, group.size), "raw")
        ends = [float(np.minimum(low, high)[part].min()), float(np.maximum(low, high)[part].max())]
        actions[group.name] = {"name": group.name, "dims": group.size, "format": form, "range": ends}
    inputs = {camera: {"name": "image", "dims": 0, "format": "rgb_hwc_uint8"} for camera in interface.cameras}
    inputs["language"] = {"name": "language", "dims": 0, "format": "language"}
    space = interface.observation
    if space.state and not interface.images_alone:
        dims = space.state if interface.privileged else len(space.proprioception)
        form = f"privileged{dims}" if interface.privileged else "_".join(space.proprioception)
        inputs["state"] = {"name": "state", "dims": dims, "format": form}
    return {"action_spec": actions, "observation_spec": inputs}


def _gripper_format(interface: Interface) -> str:
    closes = {"signed": -1.0, "signed_inverted": 1.0}.get(interface.gripper, interface.grip[0] if interface.grip else 0)
    return {-1.0: "binary_close_negative", 1.0: "binary_close_positive"}.get(closes, "continuous_01")


def observation_params(interface: Interface) -> dict[str, object]:
    """Arguments that a benchmark of the policy's own environment takes over where its YAML does not say."""
    if not interface.grip or interface.images_alone:
        return {}
    if not interface.cameras:
        return {"send_images": False, "privileged": interface.privileged}
    return {"camera": interface.cameras[0], "image_size": interface.size}


@dataclass
class _Episode:
    """An episode in progress. path: the end effector, metres, before every action. sent: actions (D,) so far. left: of
    the chunk in hand. ids: what the harness calls the episode, empty where it does not record."""

    task: str
    seed: int
    ids: Message
    started: str
    instruction: str = ""
    begun: bool = False
    decodes: list[DecodeRecord] = field(default_factory=list)
    decode_steps: list[int] = field(default_factory=list)
    sent: list[np.ndarray] = field(default_factory=list)
    left: deque[np.ndarray] = field(default_factory=deque)
    path: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def of(cls, payload: Message) -> _Episode:
        """The episode that a message begins."""
        task, ids = (value if isinstance(value, dict) else {} for value in map(payload.get, ("task", "recording")))
        seed, index = (value if isinstance(value, int) else 0 for value in map(task.get, ("seed", "episode_idx")))
        started = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(str(task.get("name", "")), max(0, seed + index), ids, started)


class VlaEval(Conversation):
    """One client, a shard of a benchmark. It is silent while it builds a world, and its pings wait as long: none are
    sent."""

    seats, ping_s, idle_s = 64, None, 1800.0

    def __init__(self, policy: Policy, session: Session) -> None:
        super().__init__(policy, session)
        self.episode: _Episode | None = None
        self.sequence = 0

    def answer(self, frame: bytes | str) -> Reply | None:
        """The answer to a message. Raises KervError: what is wrong with it."""
        message = read_map(frame, _value)
        kind, payload, sequence = str(message.get("type")), message.get("payload"), message.get("seq")
        self.sequence = sequence if isinstance(sequence, int) else 0
        if kind not in _HANDLERS or not isinstance(payload, dict):
            raise UsageError(f"a message of type {kind[:40]}: {', '.join(_HANDLERS)} with a payload are known")
        return _HANDLERS[kind](self, payload)

    def fault(self, line: str) -> bytes:
        """The message that ends the client's episode."""
        return self._message("error", {"error": line})

    def _message(self, kind: str, payload: Mapping[str, object]) -> bytes:
        message = {"type": kind, "payload": payload, "seq": self.sequence, "timestamp": time.time()}
        return packed_as(message, _plain)

    def _hello(self, payload: Message) -> Reply:
        number = payload.get("protocol_version")
        if number != VERSION:
            raise UsageError(f"protocol version {str(number)[:20]} is not known here: this server speaks {VERSION}")
        params = observation_params(self.policy.interface)
        about = {
            "harness_version": f"kerv {version('kerv')}",
            "protocol_version": VERSION,
            "model_server": "kerv",
            "capabilities": {},
            **dim_specs(self.policy.interface),
            "kerv": self.policy.facts(),
            **({"observation_params": params} if params else {}),
        }
        return Reply(self._message("hello", about))

    def _start(self, payload: Message) -> None:
        """Notes the episode; it begins with its first observation, whose answer says what is wrong with it."""
        self.episode = _Episode.of(payload)

    def _observe(self, payload: Message) -> Reply:
        episode = self.episode = self.episode or _Episode.of({})
        state = payload.get("state", payload.get("states"))
        numbers = self.policy.interface.numbers(state, "state", payload)
        felt = Observation(*numbers)
        hand = hand_of(felt)
        if not episode.begun:
            self.session.begin(self.policy.interface.task or episode.task, episode.seed, hand)
            episode.begun = True
        elif len(episode.sent) == len(episode.path):
            self.session.decoder.observe(episode.sent[-1], hand)
        episode.path[len(episode.sent) :] = [hand]  # where the observation before got an error it stands there already
        if self.session.is_held(felt, bool(episode.sent)):
            episode.left.clear()  # what was planned from a state before it is not executed on
            return self._act(episode, episode.sent[-1], None)
        seconds = None
        if not episode.left:
            record = self.session.decode(self._observation(episode, payload, numbers))
            seconds = record.seconds
            episode.decodes.append(record)
            episode.decode_steps.append(len(episode.sent))
            episode.left.extend(record.actions)
        return self._act(episode, episode.left.popleft(), seconds)

    def _act(self, episode: _Episode, action: np.ndarray, seconds: float | None) -> Reply:
        """Sends an action (D,), environment units. seconds: of inference for it."""
        space = self.policy.interface.space
        episode.sent.append(np.clip(action, space.low, space.high).astype(np.float32))
        sent = self.policy.interface.converted(action[None])[0].astype(np.float32)
        return Reply(self._message("action", {"actions": sent}), seconds)

    def _observation(self, episode: _Episode, payload: Message, numbers: tuple[np.ndarray, np.ndarray]) -> Observation:
        """The observation in a payload, whose instruction the episode notes.

        Raises:
            UsageError: an image is missing or of another size or type.
        """
        images, interface = payload.get("images"), self.policy.interface
        images = images if isinstance(images, dict) else {}
        prompt = text_of(payload.get("task_description", ""), "task_description")
        frames = {}
        for camera in interface.cameras:
            if camera not in images:
                raise UsageError(f"no image of camera {camera}: the message has images of {keys_of(images)}")
            image = images[camera]
            frames[camera] = interface.image(image() if callable(image) else image, camera, f"images.{camera}")
        episode.instruction = prompt
        return Observation(*numbers, prompt, frames)

    def _end(self, payload: Message) -> None:
        """Tells the decoder whether the episode succeeded, and stores the episode if the harness records it."""
        episode, self.episode = self.episode, None
        metrics = payload.get("metrics")
        metrics = metrics if isinstance(metrics, dict) else {}
        success = bool(metrics.get("success"))
        if episode is None or not episode.decodes:
            return
        self.session.decoder.finish(success)
        names = (str(episode.ids.get(key, "")) for key in ("eval_id", "eid"))
        path = path_of(results_dir(self.policy.settings.results), *names)
        if path is None:
            return
        last, elapsed = metrics.get("end_effector"), payload.get("elapsed_sec")
        if isinstance(last, list) and len(last) == 3 and all(isinstance(x, float) for x in last):
            episode.path.append(np.array(last))
        record = self._record(episode, success, float(elapsed) if isinstance(elapsed, int | float) else 0.0)
        write_served(path, record, episode.started, self.policy.facts())

    def _record(self, episode: _Episode, success: bool, elapsed: float) -> EpisodeRecord:
        interface, steps = self.policy.interface, len(episode.sent)
        moves = len(interface.observation.proprioception) >= 3 and not interface.images_alone
        return EpisodeRecord(
            environment=interface.environment,
            space=interface.space,
            task=episode.task,
            instruction=episode.instruction,
            seed=episode.seed,
            success=success,
            steps=steps,
            decodes=tuple(episode.decodes),
            decode_steps=tuple(episode.decode_steps),
            actions=np.stack(episode.sent),
            path=np.stack(episode.path).astype(np.float32) if moves else np.zeros((0, 3), np.float32),
            gripper=np.ones(steps + 1, np.float32),
            initial_state=np.zeros(0),
            wall_seconds=elapsed,
        )


_HANDLERS: Mapping[str, Callable[[VlaEval, Message], Reply | None]] = {
    "hello": VlaEval._hello,
    "episode_start": VlaEval._start,
    "observation": VlaEval._observe,
    "episode_end": VlaEval._end,
}


def _plain(value: object) -> object:
    """Numpy values as vla-eval writes them; never an image, the server sends none."""
    if isinstance(value, np.ndarray):
        return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _value(value: dict[Any, Any]) -> object:
    """An array of a message, or a function that decodes its image: most images are never used."""
    if value.get("__image__"):
        if value.get("format") == "raw":
            return array_of(value.get("dtype"), value.get("shape"), value.get("data"))
        return functools.partial(_image, value.get("data"))
    if "__ndarray__" in value:
        return array_of(value.get("dtype"), value.get("shape"), value.get("data"))
    return value


def _image(data: Any) -> np.ndarray:
    """The pixels of a PNG or JPEG file. Raises UsageError: it is none, or too large."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if max(image.size) > LARGEST:
                raise UsageError(f"an image of {image.size[0]} x {image.size[1]} pixels: at most {LARGEST} a side")
            return np.array(image)
    except KervError:
        raise
    except Exception as error:  # Pillow raises many kinds, which mean the same
        raise UsageError(f"an image cannot be read as PNG or JPEG ({type(error).__name__})") from error
