"""Serve a policy: load it, warm up its decoders, check states, and keep each client's episode."""

from __future__ import annotations

import abc
import contextlib
import math
import threading
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.registry import ArtifactPart
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder
from kerv_cli.engine.protocol import Seen, Target
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.episodes.identity import work_of
from kerv_cli.episodes.policy import artifacts_of, warm_up
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Use
from kerv_cli.methods.compose import Method
from kerv_cli.methods.settings import MethodSettings
from kerv_cli.serve.interface import Interface
from kerv_cli.serve.settings import ServeSettings
from kerv_cli.targets import TargetPart
from kerv_cli.targets.provenance import stamp
from kerv_cli.worlds import imported_name, specs

VLA_EVAL = "vla_eval"  # the protocol in which clients name the task of every episode
# Number of decodes before a new decoder serves. First decodes are slow: they allocate memory and choose kernels.
WARM_UP = 4
# Width assumed for the range of a number that hardly varied in the demonstrations, in the number's own unit
LEAST_WIDTH = 1.0


class Policy:
    """The policy and method that the server runs.

    Every client gets its own decoder. All decoders share the weights. Only one decoder decodes at a time.

    Attributes:
        chunk: H, number of control steps in an answer.
        tasks: Known tasks: instruction or name -> name.
        by_task: Whether a decoder depends on the task. This is so if the method's calibrated values or drafts depend on
            the task. Then clients must name the task.
        low: Lower ends of the ranges in which the policy may act: the demonstrations' ranges plus a margin. One per
            number of the proprioception, or of the state if the policy reads the whole state. Empty if the checkpoint
            stores no ranges, or if the policy reads no state.
        high: Upper ends of these ranges, of the same shape.
    """

    def __init__(self, settings: ServeSettings) -> None:
        if settings.policy.kind != "model":
            raise UsageError(f"policy={settings.policy.kind}: it needs the simulator and cannot be served")
        self.settings = settings
        self.artifacts = artifacts_of(settings)
        self.description = description = self.artifacts.description
        spec, name = specs().get(description.environment), settings.task_name
        self.task = spec.task(name).name if spec and name else name
        self.method = Method.of(settings)
        self.method.check(description)
        self.identity = self.artifacts.check(self.method.needs, Use(self.method.settings))
        images_alone = TargetPart.find(description.family).images_alone
        self.interface = Interface(description, spec, settings.gripper, images_alone)
        stored = ((), ()) if images_alone else description.state_range or ((), ())
        count = None if self.interface.privileged else len(description.observation.proprioception)
        low, high = np.array(stored)[:, :count]
        margin = settings.margin * np.where(high - low < LEAST_WIDTH / 100, LEAST_WIDTH, high - low)
        self.low, self.high = low - margin, high + margin
        parts = [part for kind in sorted(self.method.needs) if (part := ArtifactPart.find(kind)).by_task]
        self.by_task, task = not self.task and bool(parts), self.task
        self.tasks = {one.instruction: one.name for one in spec.tasks.values()} if spec else {}
        if self.by_task and settings.protocol == VLA_EVAL:  # warm up with any task for which the method was calibrated
            known = self.artifacts.load(parts[0].name).tasks
            self.tasks |= {name: name for name in known}
            task = next(iter(known), "")
        elif self.by_task and any(part.needs_task for part in parts):
            raise UsageError(
                f"method={settings.method}: its calibration or drafts differ between tasks: name one with task=NAME"
            )
        self._turn = threading.Lock()
        self._idle: list[Decoder] = []
        first = self.lend_decoder(task)
        self.chunk = first.steps
        self.take_back(first)

    def named(self, task: str) -> str:
        """Return a task's name. vla-eval's LIBERO sends the task's instruction instead."""
        name = imported_name(task)
        return self.tasks.get(task, name if name in self.tasks else task)

    def lend_decoder(self, task: str) -> Decoder:
        """Return a decoder for a new client: one that another client gave back, or a new one, warmed up."""
        with contextlib.suppress(IndexError):  # two clients may connect at once
            return self._idle.pop()
        with self._turn:
            decoder = self.method.decoder(self.artifacts.target, self.artifacts.load, task)
            decoder.target = Finite(decoder.target)
            if decoder.predicts is not None:
                decoder.predicts = decoder.target
            warm_up(decoder, task, self.interface.observation, self.interface.size, WARM_UP)
        return decoder

    def take_back(self, decoder: Decoder) -> None:
        if not self.by_task:
            self._idle.append(decoder)

    def check_range(self, observation: Observation) -> None:
        """Check that the state in an observation is in the range in which the policy may act."""
        numbers, names = observation.state[: len(self.low)], self.interface.observation.proprioception
        for first in np.flatnonzero((numbers < self.low) | (numbers > self.high)).tolist():
            name = names[first] if first < len(names) else f"number {first}"
            raise UsageError(
                f"the state is out of range: {name} is {numbers[first]:.4g}, the policy was trained on "
                f"{self.low[first]:.4g} to {self.high[first]:.4g}, margin included"
            )

    def decode(self, decoder: Decoder, observation: Observation) -> DecodeRecord:
        """Decode the observation of one client. Calls from several threads wait for each other."""
        with self._turn:
            record = decoder.decode(observation)
            target: Any = decoder.target
            target.check()
        return record

    @property
    def work(self) -> str:
        """Hash of the settings and weights that determine the actions."""
        return work_of(self.facts()["settings"], self.identity)

    def facts(self) -> dict[str, Any]:
        """Return settings, hashes of the policy's files, and the machine, for the server's greeting."""
        shared = {setting.name: getattr(self.settings, setting.name) for setting in fields(MethodSettings)}
        settings = asdict(RolloutSettings(**shared))
        settings["runtime"]["device"] = self.artifacts.device
        if self.interface.size:
            settings["world"]["camera"] |= {"name": self.interface.cameras[0], "size": self.interface.size}
        return {"settings": settings, "identity": self.identity, "machine": stamp(self.artifacts.device)}


class Finite:
    """Wraps a target, and checks whether its prompts, and its logits or hidden states, are finite.

    Tokens that `continue_greedily` decodes in one call are not checked.
    """

    def __init__(self, target: Target) -> None:
        self._target: Any = target
        self._fine: list[Tensor] = []  # read once per decode, so that no forward waits for the device

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)

    def encode(self, observation: Observation) -> Tensor:
        return self._noted(self._target.encode(observation))

    def head(self, hidden: Tensor) -> Tensor:
        return self._noted(self._target.head(hidden))

    def predict(self, tokens: Tensor, positions: Tensor, cache: Any, seen: Seen) -> tuple[Tensor, Tensor]:
        found, hidden = self._target.predict(tokens, positions, cache, seen)
        return found, self._noted(hidden)

    def _noted(self, numbers: Tensor) -> Tensor:
        self._fine.append(torch.isfinite(numbers).all())
        return numbers

    def check(self) -> None:
        """Check all noted numbers since the last call."""
        fine, self._fine = self._fine, []
        if fine and not bool(torch.stack(fine).all()):
            raise KervError("the policy computed numbers that are not finite: no action is sent")


class Conversation(abc.ABC):
    """One client's connection: its decoder and its episodes. Each protocol is a subclass.

    Attributes:
        seats: Largest number of clients at a time.
        ping_s: A client that does not answer a ping for this many seconds is disconnected. If None, no pings are sent.
        idle_s: A client that sends no message for this many seconds is disconnected.
        task: Task of the current episode. Empty if unknown.
        decoder: The client's decoder. None before the first episode if decoders depend on the task.
        last_ms: Milliseconds from the arrival of the last message until its answer was sent. NaN before the first
            answer.
    """

    seats: int
    ping_s: float | None
    idle_s: float

    def __init__(self, policy: Policy) -> None:
        self.policy, self.interface = policy, policy.interface
        self.task, self.last_ms = policy.task, math.nan
        self.decoder: Any = None if policy.by_task else policy.lend_decoder(self.task)

    def close(self) -> None:
        self.policy.take_back(self.decoder)

    def begin(self, task: str, seed: int, hand: np.ndarray) -> None:
        """Begin an episode.

        Args:
            hand: (3,) position of the end effector in metres.
        """
        task = self.policy.named(task)
        if self.policy.by_task and (self.decoder is None or task != self.task):
            self.decoder, self.task = self.policy.lend_decoder(task), task
        self.decoder.reset(self.task or task, seed, hand)

    def greeting(self) -> bytes | None:
        return None

    @abc.abstractmethod
    def answer(self, frame: bytes | str) -> bytes | None:
        """Return the answer to a websocket message, or None if it needs no answer."""

    @abc.abstractmethod
    def fault(self, line: str) -> bytes | str:
        """Return the websocket message that reports an error to the client. `line` is the error's text."""
