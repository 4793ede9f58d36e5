"""Speak vla-eval's protocol, version 1: a benchmark asks for one action at every control step.

A message is a msgpack map with the keys type, payload, seq and timestamp. The server answers a message of type `hello`
with a description of what the policy reads and sends. It answers every observation with one action. A new chunk is
decoded when all actions of the last chunk have been sent. The package vla-eval is not needed here.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from importlib.metadata import version

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.base.wire import Message, packed, unpacked
from kerv_cli.serve.interface import OPEN, Interface, hand_of, keys_of, text_of
from kerv_cli.serve.policy import Conversation, Policy

PROTOCOL_VERSION = 1
MOST_STEPS = 20_000  # largest number of control steps of an episode
# (Name of a group of DoFs, number of DoFs) -> vla-eval's name for the format of the group's values
_FORMATS = {("position", 3): "delta_xyz", ("rotation", 3): "axis_angle"}


def dim_specs(interface: Interface) -> dict[str, dict[str, dict[str, object]]]:
    """Describe what the policy sends (`action_spec`) and reads (`observation_spec`), in vla-eval's form (DimSpec)."""
    actions: dict[str, dict[str, object]] = {}
    ends = interface.converted(np.array([interface.actions.low, interface.actions.high]))
    for group in interface.actions.groups:
        part = interface.actions.dofs_of(group.name)
        form = _FORMATS.get((group.name, group.size), "raw")
        if interface.actions.is_strict[part].all():
            form = _gripper_format(interface)
        limits = [float(ends[:, part].min()), float(ends[:, part].max())]
        actions[group.name] = {"name": group.name, "dims": group.size, "format": form, "range": limits}
    inputs = {camera: {"name": "image", "dims": 0, "format": "rgb_hwc_uint8"} for camera in interface.cameras}
    inputs["language"] = {"name": "language", "dims": 0, "format": "language"}
    space = interface.observation
    if space.state and not interface.images_alone:
        dims = space.state if interface.privileged else len(space.proprioception)
        form = f"privileged{dims}" if interface.privileged else "_".join(space.proprioception)
        inputs["state"] = {"name": "state", "dims": dims, "format": form}
    return {"action_spec": actions, "observation_spec": inputs}


def _gripper_format(interface: Interface) -> str:
    closes = interface.grip[0]
    if interface.gripper in OPEN:
        closes = -OPEN[interface.gripper]
    return {-1.0: "binary_close_negative", 1.0: "binary_close_positive"}.get(closes, "continuous_01")


class _Episode:
    """An episode in progress. `payload` is the content of the message that starts the episode."""

    def __init__(self, payload: Message) -> None:
        task = payload.get("task")
        task = task if isinstance(task, dict) else {}
        seed, index = (value if isinstance(value, int) else 0 for value in map(task.get, ("seed", "episode_idx")))
        self.task, self.seed = str(task.get("name", "")), max(0, seed + index)
        self.begun, self.steps = False, 0
        self.sent: np.ndarray | None = None  # (D,) the last action, until it is observed
        self.left: deque[np.ndarray] = deque()  # actions of the current chunk


class VlaEval(Conversation):
    """Serve one worker (shard) of a vla-eval benchmark.

    While a worker builds a simulator, it is silent and does not answer pings. So the server sends no pings.
    """

    seats, ping_s, idle_s = 64, None, 1800.0

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self.episode: _Episode | None = None
        self.sequence = 0

    def answer(self, frame: bytes | str) -> bytes | None:
        message = unpacked(frame)
        kind, payload, sequence = str(message.get("type")), message.get("payload"), message.get("seq")
        self.sequence = sequence if isinstance(sequence, int) else 0
        if kind not in _HANDLERS or not isinstance(payload, dict):
            raise UsageError(f"a message of type {kind[:40]}: send {', '.join(_HANDLERS)}, each with a payload")
        return _HANDLERS[kind](self, payload)

    def fault(self, line: str) -> bytes:
        return self._message("error", {"error": line})

    def _message(self, kind: str, payload: Mapping[str, object]) -> bytes:
        message = {"type": kind, "payload": payload, "seq": self.sequence, "timestamp": time.time()}
        return packed(message, text_keys=True)

    def _hello(self, payload: Message) -> bytes:
        number = payload.get("protocol_version")
        if number != PROTOCOL_VERSION:
            raise UsageError(
                f"protocol version {str(number)[:20]} is unknown: this server speaks version {PROTOCOL_VERSION}"
            )
        about: dict[str, object] = {"harness_version": f"kerv {version('kerv')}", "protocol_version": PROTOCOL_VERSION}
        about |= {"model_server": "kerv", "capabilities": {}, "kerv": self.policy.facts(), **dim_specs(self.interface)}
        return self._message("hello", about)

    def _start(self, payload: Message) -> None:
        self.episode = _Episode(payload)

    def _observe(self, payload: Message) -> bytes:
        episode = self.episode = self.episode or _Episode({})
        if episode.steps >= MOST_STEPS:
            raise UsageError(f"the episode has {MOST_STEPS} control steps, the most: send episode_end or episode_start")
        numbers = self.interface.numbers(payload.get("state", payload.get("states")), "state", payload)
        state = Observation(*numbers)
        hand = hand_of(state)
        if not episode.begun:
            self.begin(self.policy.task or episode.task, episode.seed, hand)
            episode.begun = True
        elif episode.sent is not None:
            self.decoder.observe(episode.sent, hand)
            episode.sent = None
        self.policy.check_range(state)
        if not episode.left:
            record = self.policy.decode(self.decoder, self._observation(payload, numbers))
            episode.left.extend(record.actions)
        action, space = episode.left.popleft(), self.interface.space
        episode.sent = np.clip(action, space.low, space.high).astype(np.float32)
        episode.steps += 1
        sent = self.interface.converted(action[None])[0].astype(np.float32)
        return self._message("action", {"actions": sent})

    def _observation(self, payload: Message, numbers: tuple[np.ndarray, np.ndarray]) -> Observation:
        images = payload.get("images")
        images = images if isinstance(images, dict) else {}
        frames = {}
        for camera in self.interface.cameras:
            if camera not in images:
                raise UsageError(f"no image of camera {camera}: the message has images of {keys_of(images)}")
            frames[camera] = self.interface.image(images[camera], camera, f"images.{camera}")
        return Observation(*numbers, text_of(payload.get("task_description"), "task_description"), frames)

    def _end(self, payload: Message) -> None:
        episode, self.episode = self.episode, None
        metrics = payload.get("metrics")
        if episode is not None and episode.begun:
            self.decoder.finish(bool(isinstance(metrics, dict) and metrics.get("success")))


_HANDLERS: Mapping[str, Callable[[VlaEval, Message], bytes | None]] = {
    "hello": VlaEval._hello,
    "episode_start": VlaEval._start,
    "observation": VlaEval._observe,
    "episode_end": VlaEval._end,
}
