"""Runs several episodes at once in one process: each in a world of its own, all of them decoded together.

As soon as an episode ends the next one begins in its slot, so that the batch stays full until the last ones.
"""

from __future__ import annotations

import dataclasses
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.chunk import EpisodeState
from kerv_cli.engine.record import DecodeRecord, EpisodeRecord
from kerv_cli.episodes.episode import episode
from kerv_cli.worlds.spec import World

K = TypeVar("K")
OpenWorld = Callable[[str], World]
"""Task -> a new world."""


@dataclass(frozen=True)
class Request(Generic[K]):
    """An episode to run. key: whose it is, for the caller."""

    key: K
    task: str
    seed: int


EpisodeEnd = tuple[Request[K], EpisodeRecord | Exception]
"""What was requested, and its record or the error that its world raised. The record's wall_seconds are its share of the
time: that of a decode is divided by the episodes that were decoded together."""


def run_together(
    decoder: BatchDecoder, requests: Iterable[Request[K]], batch: int, open_world: OpenWorld
) -> Iterator[EpisodeEnd[K]]:
    """Runs the episodes, at most `batch` at a time, and yields each as it ends.

    A world is opened when an episode needs one and closed when its task has no episode left: the slots of a batch go
    to different tasks as long as there are enough of them, because a world costs more than a reset.
    """
    queue = _Queue(requests)
    slots: list[_Slot[K]] = [_Slot(decoder.new_episode(), open_world) for _ in range(min(batch, queue.count))]
    try:
        while True:
            for slot in slots:
                while slot.request is None and queue.count:
                    yield from slot.begin(queue.take(slot.task))
                if slot.request is None:
                    slot.close()
            live = [slot for slot in slots if slot.request is not None]
            if not live:
                return
            began = time.perf_counter()
            decodes = decoder.decode([slot.state for slot in live], [slot.observation for slot in live])
            share = (time.perf_counter() - began) / len(live)
            for slot, decode in zip(live, decodes, strict=True):
                slot.seconds += share
                yield from slot.go_on(decode)
    finally:
        for slot in slots:
            slot.close()


class _Queue(Generic[K]):
    """Episodes that have not begun, by task."""

    def __init__(self, requests: Iterable[Request[K]]) -> None:
        self.by_task: OrderedDict[str, deque[Request[K]]] = OrderedDict()
        for request in requests:
            self.by_task.setdefault(request.task, deque()).append(request)
        self.count = sum(map(len, self.by_task.values()))

    def take(self, task: str) -> Request[K]:
        """The next request of this task; where it has none, of the task with the most."""
        if not self.by_task.get(task):
            task = max(self.by_task, key=lambda name: len(self.by_task[name]))
        self.count -= 1
        return self.by_task[task].popleft()


class _Slot(Generic[K]):
    """A slot of the batch: its open world and the episode that runs in it. seconds: time of that episode so far."""

    def __init__(self, state: EpisodeState, open_world: OpenWorld) -> None:
        self.state, self.open_world = state, open_world
        self.task, self.seconds = "", 0.0
        self.world: World | None = None
        self.request: Request[K] | None = None

    def begin(self, request: Request[K]) -> Iterator[EpisodeEnd[K]]:
        """Begins an episode; yields it where it ends at once."""
        self.request, self.seconds = request, 0.0
        yield from self.go_on(None)

    def go_on(self, decode: DecodeRecord | None) -> Iterator[EpisodeEnd[K]]:
        """Executes a decode, None at the beginning, up to the next observation; yields the episode where it ends."""
        began, request = time.perf_counter(), self.request
        assert request is not None
        try:
            if decode is None:
                self.steps = self._episode(request)
            self.observation = next(self.steps) if decode is None else self.steps.send(decode)
            self.seconds += time.perf_counter() - began
            return
        except StopIteration as end:
            self.seconds += time.perf_counter() - began
            result: EpisodeRecord | Exception = dataclasses.replace(end.value, wall_seconds=self.seconds)
        except Exception as error:  # noqa: BLE001 - one world's failure of any kind must not end the others
            result = error
            self.close()
        self.request = None
        yield request, result

    def _episode(self, request: Request[K]) -> Generator[Observation, DecodeRecord, EpisodeRecord]:
        if self.world is None or self.task != request.task:
            self.close()
            self.world, self.task = self.open_world(request.task), request.task
        return episode(self.world, self.state, request.seed)

    def close(self) -> None:
        """Closes the world."""
        if self.world is not None:
            self.world.close()
        self.world, self.task = None, ""
