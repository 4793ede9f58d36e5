"""Speak openpi's protocol, which is meant for robots.

After the handshake the server sends its metadata. Then the client sends observations as binary websocket messages. The
server answers an observation with a chunk of actions, or with a text message that says what is wrong with it.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.base.wire import Message, packed, unpacked
from kerv_cli.report.tally import Tally
from kerv_cli.serve.interface import Interface, hand_of, keys_of, text_of
from kerv_cli.serve.policy import Conversation, Policy

STATE, IMAGE, PROMPT, RESET, EXECUTED = "observation/state", "observation/image", "prompt", "reset", "executed"


def metadata(policy: Policy) -> dict[str, object]:
    """Return what the server tells a new client about the policy: cameras, state, actions, limits and chunk length."""
    interface, actions = policy.interface, policy.interface.actions
    about = {"server": "kerv", "policy": policy.settings.policy.target, "method": policy.settings.method}
    about["work"] = policy.work
    images = {"cameras": list(interface.cameras), "image_size": interface.size}
    state = {"state": list(interface.observation.proprioception)}
    limits = {"actions": list(actions.names), "low": list(actions.low), "high": list(actions.high)}
    timing = {"control_hz": actions.control_hz, "chunk": policy.chunk, "gripper": interface.gripper}
    return {**about, **images, **state, **limits, **timing}


def observation_of(interface: Interface, message: Message) -> Observation:
    images = {}
    for camera in interface.cameras:
        keys = [f"observation/{camera}", *([IMAGE] if len(interface.cameras) == 1 else [])]
        key = next((key for key in keys if key in message), None)
        if key is None:
            raise UsageError(f"no image: {' or '.join(keys)} is wanted, the message has {keys_of(message)}")
        images[camera] = interface.image(message[key], camera, key)
    numbers = interface.numbers(message.get(STATE), STATE, message)
    return Observation(*numbers, text_of(message.get(PROMPT), PROMPT), images)


class OpenPi(Conversation):
    """Serve one robot at a time. A robot that sends nothing for two minutes is disconnected.

    Attributes:
        last: (H, D) actions of the latest answer, for H control steps and D DoFs, in environment units.
        last_hand: (3,) position of the end effector when that answer was computed, in metres.
        decodes: Number of answers so far.
        tally: How many draft tokens were accepted in all answers so far.
    """

    seats, ping_s, idle_s = 1, 10.0, 120.0

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self.last, self.last_hand = np.zeros((0, 0)), np.zeros(3)
        self.decodes = 0
        self.tally = Tally.of_records((), self.interface.actions.kinds)

    def greeting(self) -> bytes:
        return packed(metadata(self.policy))

    def answer(self, frame: bytes | str) -> bytes:
        return packed(self.act(unpacked(frame)))

    def act(self, message: Message) -> dict[str, Any]:
        """Return the values of the answer to a client's message: actions, times, forwards and acceptance."""
        began = time.perf_counter()
        observation, executed = observation_of(self.interface, message), self._executed(message)
        hand, reset = hand_of(observation), message.get(RESET)
        if not isinstance(reset, bool | int | np.bool_ | np.integer | None):
            raise UsageError(f"{RESET} is {type(reset).__name__}, true or false is wanted")
        if reset or not self.decodes:
            self.last = self.last[:0]
            self.begin(self.task, self.decodes, hand)
        else:
            for step, action in enumerate(executed, 1):
                self.decoder.observe(action, self.last_hand + (hand - self.last_hand) * step / len(executed))
        self.policy.check_range(observation)
        record = self.policy.decode(self.decoder, observation)
        self.last, self.last_hand = record.actions, hand
        self.decodes += 1
        self.tally += Tally.of_records((record,), self.interface.actions.kinds)
        answer: dict[str, Any] = {"actions": self.interface.converted(record.actions)}
        answer["policy_timing"] = {"infer_ms": 1000 * record.seconds}
        answer["decode"] = {"forwards": record.forwards, "tokens": len(record.tokens), "mode": record.mode}
        if self.tally.drafts:
            answer["spec_decode"] = self.tally.as_dict()
        before = {} if math.isnan(self.last_ms) else {"prev_total_ms": self.last_ms}
        return {**answer, "server_timing": {"infer_ms": 1000 * (time.perf_counter() - began), **before}}

    def fault(self, line: str) -> str:
        return f"kerv: {line}"

    def _executed(self, message: Message) -> np.ndarray:
        count = message.get(EXECUTED, len(self.last))
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 0 <= count <= len(self.last):
            raise UsageError(
                f"{EXECUTED}={str(count)[:40]}: must be 0 to {len(self.last)}, the control steps of the last answer"
            )
        return self.last[: int(count)]
