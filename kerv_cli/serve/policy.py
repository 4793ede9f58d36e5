"""The served policy from its settings: its interface, and decoders that are warmed up, one for every client."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.provenance import stamp
from kerv_cli.base.registry import find
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.chunk import EpisodeState
from kerv_cli.engine.decoder import Decoder
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.episodes.episode import Follower
from kerv_cli.episodes.policy import artifacts_of, warm_up
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Use
from kerv_cli.methods.compose import Method
from kerv_cli.methods.settings import MethodSettings
from kerv_cli.serve.guard import HOLD, Finite, StateRange
from kerv_cli.serve.session import Interface, Session
from kerv_cli.serve.settings import ServeSettings
from kerv_cli.worlds import specs

VLA_EVAL = "vla_eval"
"""The protocol whose clients name the task of every episode."""
WARM_UP = 4  # decodes
GATHER = 0.005
"""Seconds that a batch waits for more clients."""


class Policy:
    """What is served. Its clients' decoders share the weights; one of them decodes at a time, or several together.

    chunk: H. by_task: whether the method's parts differ between tasks, which the clients name.

    Raises:
        UsageError: numbers out of range, parts that do not belong together. CheckpointError: no such policy, or an
            artifact of another.
    """

    def __init__(self, settings: ServeSettings) -> None:
        if settings.policy.kind != "model":
            raise UsageError(f"policy={settings.policy.kind}: it acts in the simulator's worlds and cannot be served")
        self.settings = settings
        self.artifacts = artifacts_of(settings)
        self.task = self._task()
        self.method = Method.of(settings)
        description = self.artifacts.description
        self.method.check(description, settings.batch, "batch")
        use = Use(self.method.settings, settings.runtime.dtype, description.environment)
        self.identity = self.artifacts.check(self.method.needs, use)
        self.interface = self._interface()
        self.range = self._range()
        self.by_task = not self.task and bool(self._artifacts_with("by_task"))
        if self.by_task and settings.protocol != VLA_EVAL and self._artifacts_with("needs_task"):
            raise UsageError(
                f"method={settings.method}: its levels or drafts differ between tasks: name one with task=NAME"
            )
        self._turn = threading.Lock()
        self._idle: list[Decoder] = []
        first = self._decoder(self._any_task())
        self.chunk = first.steps
        self._together = Together(BatchDecoder(first), settings.batch) if settings.batch > 1 else None
        if not self.by_task:
            self._idle.append(first)

    def _task(self) -> str:
        """The full name of the settings' task; empty: none.

        Raises:
            UnknownName: the policy's environment has no such task.
        """
        name, spec = self.settings.task_name, specs().get(self.artifacts.description.environment)
        if not name or spec is None:
            return name
        full = spec.expand(name)
        if len(full) != 1:
            raise UnknownName("task", name, spec.tasks)
        return str(full[0])

    def _interface(self) -> Interface:
        description = self.artifacts.description
        spec = specs().get(description.environment)
        return Interface(
            name=self.settings.policy.target,
            method=self.settings.method,
            environment=description.environment,
            actions=description.actions,
            space=spec.actions if spec else description.actions,
            observation=description.observation,
            cameras=tuple(description.cameras),
            size=int(description.settings.get("image_size", 0)) if description.cameras else 0,
            privileged=not description.cameras and description.observation.state > 0,
            gripper=self.settings.gripper,
            grip=tuple(spec.grip) if spec else (),
            task=self.task,
            images_alone=bool(find("target", description.family).traits.get("images_alone")),
        )

    def _range(self) -> StateRange | None:
        """The range of the numbers that the policy reads; None where its target does not say, or it reads none."""
        stored, interface = self.artifacts.description.state_range, self.interface
        if stored is None or interface.images_alone:
            return None
        names = interface.observation.proprioception
        low, high = (np.array(ends)[: None if interface.privileged else len(names)] for ends in stored)
        return StateRange(low, high, names, self.settings.margin)

    def _artifacts_with(self, trait: str) -> list[str]:
        return sorted(kind for kind in self.method.needs if find("artifact", kind).traits.get(trait))

    def _any_task(self) -> str:
        """The task of the settings; without one, where a client names its tasks, one for which the method has
        levels."""
        if not self.by_task or self.settings.protocol != VLA_EVAL:
            return self.task
        artifact = self.artifacts.load(self._artifacts_with("by_task")[0])
        return next(iter(artifact.tasks), "")

    @contextlib.contextmanager
    def session(self) -> Iterator[Session]:
        """A session for one more client; when it leaves, its decoder serves the next one."""
        session = self.new_session()
        try:
            yield session
        finally:
            if isinstance(session.decoder, Decoder) and not self.by_task:
                self._idle.append(session.decoder)

    def new_session(self) -> Session:
        """A session for one more client."""
        holds = self.settings.outside == HOLD
        return Session(self._client_decoder, self.task, self.by_task, self.range, holds, self._decode)

    def _client_decoder(self, task: str) -> Follower:
        if self._together is not None:
            return self._together.decoder.new_episode()
        return self._idle.pop() if self._idle else self._decoder(task)

    def _decode(self, decoder: Any, observation: Observation) -> DecodeRecord:
        """The record of a client's observation. One decoder decodes at a time."""
        if self._together is not None:
            return self._together.decode(decoder, observation)
        with self._turn:
            record: DecodeRecord = decoder.decode(observation)
            check_finite(decoder)
        return record

    def _decoder(self, task: str) -> Decoder:
        """A new decoder, after a few observations of zeros: first calls allocate memory and choose kernels."""
        with self._turn:
            decoder = self.method.decoder(self.artifacts.target, self.artifacts.load, task)
            decoder.target = Finite(decoder.target)
            warm_up(decoder, task, self.interface.observation, self.interface.size, WARM_UP)
        return decoder

    def facts(self) -> dict[str, object]:
        """The settings of a rollout, hashes, machine and versions that belong to its results; plain values."""
        shared = {at.name: getattr(self.settings, at.name) for at in fields(MethodSettings)}
        settings = asdict(RolloutSettings(**shared))
        settings["runtime"]["device"] = self.artifacts.device
        camera = {"name": self.interface.cameras[0] if self.interface.cameras else "", "size": self.interface.size}
        settings["world"]["camera"] |= {key: value for key, value in camera.items() if value}
        return {"settings": settings, "identity": self.identity, "machine": stamp(self.artifacts.device)}


def check_finite(decoder: Decoder | BatchDecoder) -> None:
    """Raises KervError: the last decode computed numbers that are not finite."""
    target: Any = decoder.target
    target.check()


@dataclass(frozen=True)
class _Request:
    episode: EpisodeState
    observation: Observation
    answer: Future[DecodeRecord] = field(default_factory=Future)


@dataclass
class Together:
    """Decodes the observations of several clients as one batch. most: clients of a batch."""

    decoder: BatchDecoder
    most: int
    _turn: threading.Lock = field(default_factory=threading.Lock)
    _arrived: threading.Condition = field(default_factory=threading.Condition)
    _waiting: list[_Request] = field(default_factory=list)

    def decode(self, episode: EpisodeState, observation: Observation) -> DecodeRecord:
        """The record of one client's observation. Whoever has the turn decodes for all who wait."""
        mine = _Request(episode, observation)
        with self._arrived:
            self._waiting.append(mine)
            self._arrived.notify_all()
        with self._turn:
            while not mine.answer.done():
                with self._arrived:
                    self._arrived.wait_for(lambda: len(self._waiting) >= self.most, GATHER)
                    batch, self._waiting = self._waiting[: self.most], self._waiting[self.most :]
                self._settle(batch)
        return mine.answer.result()

    def _settle(self, batch: Sequence[_Request]) -> None:
        """Decodes the batch; where that fails, one by one, so that one client's fault is no other's."""
        try:
            records = self.decoder.decode([one.episode for one in batch], [one.observation for one in batch])
            check_finite(self.decoder)
            for one, record in zip(batch, records, strict=True):
                one.answer.set_result(record)
        except Exception as error:  # noqa: BLE001 - it is raised in its client's thread
            if len(batch) == 1:
                batch[0].answer.set_exception(error)
                return
            for one in batch:
                self._settle([one])
