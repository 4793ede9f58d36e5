"""One client of a served policy, whatever its protocol."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.serve.guard import HOLD
from kerv_cli.serve.policy import Policy

Log = Callable[[str], None]


class Reply(NamedTuple):
    """The answer to a frame.

    Attributes:
        frame: What is sent.
        seconds: Inference time, NaN if it was not measured; None if nothing was decoded.
    """

    frame: bytes
    seconds: float | None = None


class Conversation(abc.ABC):
    """A client's episodes, decoded by a decoder of its own. A protocol is a subclass.

    Attributes:
        seats: Clients at a time.
        ping_s: Seconds without an answer to a ping after which a client is gone; None sends no pings.
        idle_s: Seconds without a message after which it is gone.
        decoder: None before the first episode if it depends on the task.
        last_ms: Milliseconds from the last decoded frame's arrival to the answer's end.
    """

    seats: int
    ping_s: float | None
    idle_s: float

    def __init__(self, policy: Policy, log: Log = lambda line: None) -> None:
        self.policy, self.interface, self.log = policy, policy.interface, log
        self.task, self.last_ms = policy.task, math.nan
        self.decoder: Any = None if policy.by_task else policy.lend_decoder(self.task)

    def close(self) -> None:
        """Give the decoder back, for the next client."""
        self.policy.take_back(self.decoder)

    def begin(self, task: str, seed: int, hand: np.ndarray) -> None:
        """Begin an episode with the end effector at `hand` (3,) metres.

        Raises:
            CheckpointError: The method has no levels for the task.
        """
        if self.policy.by_task and (self.decoder is None or task != self.task):
            self.decoder, self.task = self.policy.lend_decoder(task), task
        self.decoder.reset(self.task or task, seed, hand)

    def holds(self, observation: Observation, has_last: bool) -> bool:
        """Return whether the last action is executed again, because the policy may not act on this state.

        Raises:
            UsageError: It may not, and errors are wanted or the episode has no last action.
        """
        why = self.policy.range.outside(observation) if self.policy.range else ""
        if why and not (self.policy.settings.outside == HOLD and has_last):
            raise UsageError(why)
        if why:
            self.log(f"{why}: the last action is held")
        return bool(why)

    def decode(self, observation: Observation) -> DecodeRecord:
        """Return the actions for an observation, and their record."""
        return self.policy.decode(self.decoder, observation)

    def greeting(self) -> bytes | None:
        """Return what the server says first; None if the client speaks first."""
        return None

    @abc.abstractmethod
    def answer(self, frame: bytes | str) -> Reply | None:
        """Return the answer to a frame, or None; raise KervError if something is wrong with it."""

    @abc.abstractmethod
    def fault(self, line: str) -> bytes | str:
        """Return the frame that tells the client what was wrong with its last one."""
