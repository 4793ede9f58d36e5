"""openpi's protocol: after the handshake the server sends its metadata; then every binary frame is an observation and
is answered by a chunk of actions, or by a text frame that says what was wrong with it."""

from __future__ import annotations

from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.serve.guard import HOLD
from kerv_cli.serve.policy import Policy
from kerv_cli.serve.server import Conversation, Reply
from kerv_cli.serve.session import Interface, Session, hand_of, keys_of, text_of
from kerv_cli.serve.wire import Message, packed, unpacked

STATE, IMAGE, PROMPT, RESET, EXECUTED = "observation/state", "observation/image", "prompt", "reset", "executed"


def metadata(interface: Interface, chunk: int) -> dict[str, object]:
    """The first frame that a client gets. chunk: H."""
    return {
        "server": "kerv",
        "policy": interface.name,
        "method": interface.method,
        "cameras": list(interface.cameras),
        "image_size": interface.size,
        "state": list(interface.observation.proprioception),
        "actions": list(interface.actions.names),
        "low": list(interface.actions.low),
        "high": list(interface.actions.high),
        "control_hz": interface.actions.control_hz,
        "chunk": chunk,
        "gripper": interface.gripper,
    }


def observation_of(interface: Interface, message: Message) -> Observation:
    """The observation in a message.

    Raises:
        UsageError: something is missing, of another size or type, or not finite; the line names it.
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
    """One client. A robot executes what it is sent, so that there is one at a time, and silence means that it is gone.

    last: the actions (H, D) of the last decode, environment units. last_hand: the end effector's position (3,) at that
    decode, metres. last_ms: milliseconds that the last answer took.
    """

    seats, ping_s, idle_s = 1, 10.0, 120.0

    def __init__(self, policy: Policy, session: Session) -> None:
        super().__init__(policy, session)
        self.last: np.ndarray = np.zeros((0, 0))
        self.last_hand = np.zeros(3)
        self.decodes, self.begun = 0, False
        self.last_ms: float | None = None

    def greeting(self) -> bytes:
        """The metadata."""
        return packed(metadata(self.policy.interface, self.policy.chunk))

    def answer(self, frame: bytes | str) -> Reply:
        """The answer to the observation in a frame. Raises UsageError: it holds none, or a wrong `executed`."""
        values = self.act(unpacked(frame))
        return Reply(packed(values), values["policy_timing"]["infer_ms"] / 1000)

    def act(self, message: Message) -> dict[str, Any]:
        """The actions (H, D) for the observation in a message, their time and their forwards.

        Raises:
            UsageError: as `observation_of`, or a wrong `executed` or `reset`.
        """
        interface, decoder = self.policy.interface, self.session.decoder
        observation = observation_of(interface, message)
        hand, executed = hand_of(observation), self._executed(message)
        reset = message.get(RESET)
        if not isinstance(reset, bool | int | np.bool_ | np.integer | None):
            raise UsageError(f"{RESET} is {type(reset).__name__}, true or false is wanted")
        if reset or not self.begun:
            self.last = self.last[:0]
            self.session.begin(interface.task, self.decodes, hand)
            self.begun = True
        else:
            for step, action in enumerate(executed, 1):
                decoder.observe(action, self.last_hand + (hand - self.last_hand) * step / len(executed))
        if self.session.is_held(observation, len(self.last) > 0):
            record = DecodeRecord((), self.last[-1:], 0, (), HOLD, 0.0, {})
        else:
            record = self.session.decode(observation)
        self.last, self.last_hand = record.actions, hand
        self.decodes += 1
        timing = {"infer_ms": 1000 * record.seconds}
        return {
            "actions": interface.converted(record.actions),
            "policy_timing": timing,
            "decode": {"forwards": record.forwards, "tokens": len(record.tokens), "mode": record.mode},
            "server_timing": timing | ({"prev_total_ms": self.last_ms} if self.last_ms is not None else {}),
        }

    def note_latency(self, milliseconds: float) -> None:
        """The last answer took so long as a whole; the client is told with the next one."""
        self.last_ms = milliseconds

    def fault(self, line: str) -> str:
        """The frame that says what was wrong."""
        return f"kerv: {line}"

    def _executed(self, message: Message) -> np.ndarray:
        """The actions of the last answer that were executed since: all of them, or the first `executed` ones."""
        count = message.get(EXECUTED, len(self.last))
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 0 <= count <= len(self.last):
            raise UsageError(f"{EXECUTED}={str(count)[:40]}: 0 to {len(self.last)} control steps of the last answer")
        return self.last[: int(count)]
