"""openpi's protocol, for robots.

After the handshake the server sends its metadata. Then every binary frame is an observation, answered by a chunk of
actions, or by a text frame that says what was wrong with it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.serve.interface import Interface, Message, hand_of, keys_of, packed, text_of, unpacked
from kerv_cli.serve.policy import HOLD, Conversation, Log, Policy, Reply

STATE, IMAGE, PROMPT, RESET, EXECUTED = "observation/state", "observation/image", "prompt", "reset", "executed"


def metadata(policy: Policy) -> dict[str, object]:
    """Return the first message that a client gets."""
    interface = policy.interface
    return {
        "server": "kerv",
        "policy": policy.settings.policy.target,
        "method": policy.settings.method,
        "cameras": list(interface.cameras),
        "image_size": interface.size,
        "state": list(interface.observation.proprioception),
        "actions": list(interface.actions.names),
        "low": list(interface.actions.low),
        "high": list(interface.actions.high),
        "control_hz": interface.actions.control_hz,
        "chunk": policy.chunk,
        "gripper": interface.gripper,
    }


def observation_of(interface: Interface, message: Message) -> Observation:
    """Return the observation in a message.

    Raises:
        UsageError: Something is missing, of another size or type, or not finite; the line names it.
    """
    prompt = text_of(message.get(PROMPT, ""), PROMPT)
    images = {}
    for camera in interface.cameras:
        keys = [f"observation/{camera}", *([IMAGE] if len(interface.cameras) == 1 else [])]
        key = next((key for key in keys if key in message), None)
        if key is None:
            raise UsageError(f"no image: {' or '.join(keys)} is wanted, the message has {keys_of(message)}")
        images[camera] = interface.image(message[key], camera, key)
    return Observation(*interface.numbers(message.get(STATE), STATE, message), prompt, images)


class OpenPi(Conversation):
    """A robot, which executes what it is sent: one at a time, and silence means that it is gone.

    Attributes:
        last: (H, D) actions of the last decode, environment units.
        last_hand: (3,) position of the end effector at that decode, metres.
    """

    seats, ping_s, idle_s = 1, 10.0, 120.0

    def __init__(self, policy: Policy, log: Log = lambda line: None) -> None:
        super().__init__(policy, log)
        self.last, self.last_hand = np.zeros((0, 0)), np.zeros(3)
        self.decodes = 0

    def greeting(self) -> bytes:
        """Return the metadata."""
        return packed(metadata(self.policy))

    def answer(self, frame: bytes | str) -> Reply:
        """Return the actions for the observation in a frame; raise as `act`."""
        values = self.act(unpacked(frame))
        return Reply(packed(values), values["policy_timing"]["infer_ms"] / 1000)

    def act(self, message: Message) -> dict[str, Any]:
        """Return the actions (H, D) for the observation in a message, with times and forwards.

        Raises:
            UsageError: As `observation_of`, or a wrong `executed` or `reset`.
        """
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
        if self.holds(observation, len(self.last) > 0):
            record = DecodeRecord((), self.last[-1:], 0, (), HOLD, 0.0, {})
        else:
            record = self.policy.decode(self.decoder, observation)
        self.last, self.last_hand = record.actions, hand
        self.decodes += 1
        timing = {"infer_ms": 1000 * record.seconds}
        return {
            "actions": self.interface.converted(record.actions),
            "policy_timing": timing,
            "decode": {"forwards": record.forwards, "tokens": len(record.tokens), "mode": record.mode},
            "server_timing": timing | ({} if math.isnan(self.last_ms) else {"prev_total_ms": self.last_ms}),
        }

    def fault(self, line: str) -> str:
        """Return the frame that says what was wrong."""
        return f"kerv: {line}"

    def _executed(self, message: Message) -> np.ndarray:
        """Return the actions executed since the last answer: all of its actions, or the first `executed` ones."""
        count = message.get(EXECUTED, len(self.last))
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 0 <= count <= len(self.last):
            raise UsageError(f"{EXECUTED}={str(count)[:40]}: 0 to {len(self.last)} control steps of the last answer")
        return self.last[: int(count)]
