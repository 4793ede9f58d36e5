"""The served policy: its interface, decoders that are warmed up, what it refuses to act on, and a client's episodes."""

from __future__ import annotations

import abc
import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.registry import find
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.chunk import EpisodeState
from kerv_cli.engine.decoder import Decoder
from kerv_cli.engine.protocol import Target
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.episodes.policy import artifacts_of, warm_up
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Use
from kerv_cli.methods.compose import Method
from kerv_cli.methods.settings import MethodSettings
from kerv_cli.serve.interface import Interface
from kerv_cli.serve.settings import ServeSettings
from kerv_cli.targets.provenance import stamp
from kerv_cli.worlds import specs
from kerv_cli.worlds.spec import EnvironmentSpec

VLA_EVAL = "vla_eval"
"""The protocol whose clients name the task of every episode."""
WARM_UP = 4
"""Decodes before a new decoder serves: first calls allocate memory and choose kernels."""
GATHER = 0.005
"""Seconds that a batch waits for more clients."""


class Policy:
    """What is served. Its decoders share the weights; one decodes at a time, or several together.

    Attributes:
        chunk: H, control steps of an answer.
        by_task: Whether the method's parts differ between tasks, which the clients name.
        range: Range of the states it may act on; None if its target does not say.

    Raises:
        UnknownName: The policy's environment has no task of that name.
        UsageError: Numbers out of range, or parts that do not belong together.
        CheckpointError: No such policy, or an artifact of another one.
    """

    def __init__(self, settings: ServeSettings) -> None:
        if settings.policy.kind != "model":
            raise UsageError(f"policy={settings.policy.kind}: it acts in the simulator's worlds and cannot be served")
        self.settings = settings
        self.artifacts = artifacts_of(settings)
        self.description = self.artifacts.description
        spec, name = specs().get(self.description.environment), settings.task_name
        self.task = spec.task(name).name if spec and name else name
        self.method = Method.of(settings)
        self.method.check(self.description, settings.batch, "batch")
        use = Use(self.method.settings, settings.runtime.dtype, self.description.environment)
        self.identity = self.artifacts.check(self.method.needs, use)
        self.interface = self._interface(spec)
        self.range = self._range()
        self.by_task = not self.task and bool(self._artifacts_with("by_task"))
        if self.by_task and settings.protocol != VLA_EVAL and self._artifacts_with("needs_task"):
            raise UsageError(
                f"method={settings.method}: its levels or drafts differ between tasks: name one with task=NAME"
            )
        self._turn = threading.Lock()
        first = self._new_decoder(self._any_task())
        self.chunk = first.steps
        self._together = Together(BatchDecoder(first), settings.batch) if settings.batch > 1 else None
        self._idle: list[Decoder] = [] if self.by_task else [first]

    def _interface(self, spec: EnvironmentSpec | None) -> Interface:
        description = self.description
        return Interface(
            actions=description.actions,
            space=spec.actions if spec else description.actions,
            observation=description.observation,
            cameras=tuple(description.cameras),
            size=int(description.settings.get("image_size", 0)) if description.cameras else 0,
            privileged=not description.cameras and description.observation.state > 0,
            images_alone=bool(find("target", description.family).traits.get("images_alone")),
            gripper=self.settings.gripper,
            grip=tuple(spec.grip) if spec else (),
        )

    def _range(self) -> StateRange | None:
        stored, interface = self.description.state_range, self.interface
        if stored is None or interface.images_alone:
            return None
        names = interface.observation.proprioception
        low, high = (np.array(ends)[: None if interface.privileged else len(names)] for ends in stored)
        return StateRange(low, high, names, self.settings.margin)

    def _artifacts_with(self, trait: str) -> list[str]:
        return sorted(kind for kind in self.method.needs if find("artifact", kind).traits.get(trait))

    def _any_task(self) -> str:
        """Return a task that the method can decode: the settings', or one for which it has levels."""
        if not self.by_task or self.settings.protocol != VLA_EVAL:
            return self.task
        artifact = self.artifacts.load(self._artifacts_with("by_task")[0])
        return next(iter(artifact.tasks), "")

    def lend_decoder(self, task: str) -> Decoder | EpisodeState:
        """Return a decoder for one more client, or its part in a batch."""
        if self._together is not None:
            return self._together.decoder.new_episode()
        return self._idle.pop() if self._idle else self._new_decoder(task)

    def take_back(self, decoder: Any) -> None:
        """Keep a lent decoder for the next client, unless it depends on a task."""
        if isinstance(decoder, Decoder) and not self.by_task:
            self._idle.append(decoder)

    def decode(self, decoder: Any, observation: Observation) -> DecodeRecord:
        """Decode a client's observation. One decoder works at a time.

        Raises:
            KervError: The decode computed numbers that are not finite.
        """
        if self._together is not None:
            return self._together.decode(decoder, observation)
        with self._turn:
            record: DecodeRecord = decoder.decode(observation)
            decoder.target.check()
        return record

    def _new_decoder(self, task: str) -> Decoder:
        with self._turn:
            decoder = self.method.decoder(self.artifacts.target, self.artifacts.load, task)
            decoder.target = Finite(decoder.target)
            warm_up(decoder, task, self.interface.observation, self.interface.size, WARM_UP)
        return decoder

    def facts(self) -> dict[str, object]:
        """Return what belongs to the policy's results: settings of a rollout, hashes, machine and versions."""
        shared = {setting.name: getattr(self.settings, setting.name) for setting in fields(MethodSettings)}
        settings = asdict(RolloutSettings(**shared))
        settings["runtime"]["device"] = self.artifacts.device
        if self.interface.size:
            settings["world"]["camera"] |= {"name": self.interface.cameras[0], "size": self.interface.size}
        return {"settings": settings, "identity": self.identity, "machine": stamp(self.artifacts.device)}


@dataclass(frozen=True)
class _Request:
    episode: EpisodeState
    observation: Observation
    answer: Future[DecodeRecord] = field(default_factory=Future)


class Together:
    """Decodes the observations of up to `most` clients as one batch."""

    def __init__(self, decoder: BatchDecoder, most: int) -> None:
        self.decoder, self.most = decoder, most
        self._turn, self._arrived = threading.Lock(), threading.Condition()
        self._waiting: list[_Request] = []

    def decode(self, episode: EpisodeState, observation: Observation) -> DecodeRecord:
        """Decode one client's observation. Whoever has the turn decodes for all who wait."""
        mine = _Request(episode, observation)
        with self._arrived:
            self._waiting.append(mine)
            self._arrived.notify_all()
        with self._turn:
            while not mine.answer.done():
                with self._arrived:
                    self._arrived.wait_for(lambda: len(self._waiting) >= self.most, GATHER)
                    batch, self._waiting = self._waiting[: self.most], self._waiting[self.most :]
                self._answer(batch)
        return mine.answer.result()

    def _answer(self, batch: Sequence[_Request]) -> None:
        """Decode the batch; if that fails, one by one, so that one client's fault is no other's."""
        target: Any = self.decoder.target
        try:
            records = self.decoder.decode([one.episode for one in batch], [one.observation for one in batch])
            target.check()
            for one, record in zip(batch, records, strict=True):
                one.answer.set_result(record)
        except Exception as error:  # noqa: BLE001 - it is raised in its client's thread
            if len(batch) == 1:
                batch[0].answer.set_exception(error)
                return
            for one in batch:
                self._answer([one])


HOLD = "hold"
"""Answer to a state out of range: the last action once more, instead of an error."""
LEAST_WIDTH = 1.0
"""Width of the range of a number that hardly moved in the demonstrations, in its own unit."""


class StateRange:
    """The range of the states on which a policy may act.

    Args:
        low: (p,) lowest numbers of the demonstrations.
        high: (p,) highest numbers.
        names: Names of the first numbers.
        margin: How many widths of the range are added on each side.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, names: tuple[str, ...], margin: float) -> None:
        added = margin * np.where(high - low < LEAST_WIDTH / 100, LEAST_WIDTH, high - low)
        self.low, self.high, self.names = low - added, high + added, names

    def outside(self, observation: Observation) -> str:
        """Say which number is out of range; empty if none is."""
        numbers = observation.state[: len(self.low)]
        beyond = np.flatnonzero((numbers < self.low) | (numbers > self.high))
        if not len(beyond):
            return ""
        first = int(beyond[0])
        name = self.names[first] if first < len(self.names) else f"number {first}"
        return (
            f"the state is out of range: {name} is {numbers[first]:.4g}, the policy was trained on "
            f"{self.low[first]:.4g} to {self.high[first]:.4g}, margin included"
        )


class Finite:
    """A target that notes whether its prompts and logits are finite."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._fine: list[Tensor] = []  # read once per decode, so that no forward waits for the device

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)

    def encode(self, observation: Observation) -> Tensor:
        """Return the target's prompt."""
        return self._noted(self._target.encode(observation))

    def head(self, hidden: Tensor) -> Tensor:
        """Return the target's logits."""
        return self._noted(self._target.head(hidden))

    def _noted(self, numbers: Tensor) -> Tensor:
        self._fine.append(torch.isfinite(numbers).all())
        return numbers

    def check(self) -> None:
        """Raise KervError if the decode computed numbers that are not finite."""
        fine, self._fine = self._fine, []
        if fine and not bool(torch.stack(fine).all()):
            raise KervError("the policy computed numbers that are not finite: no action is sent")


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

    def greeting(self) -> bytes | None:
        """Return what the server says first; None if the client speaks first."""
        return None

    @abc.abstractmethod
    def answer(self, frame: bytes | str) -> Reply | None:
        """Return the answer to a frame, or None; raise KervError if something is wrong with it."""

    @abc.abstractmethod
    def fault(self, line: str) -> bytes | str:
        """Return the frame that tells the client what was wrong with its last one."""
