"""Runs several episodes at once in one process: each in a world of its own, all of them decoded together.

When an episode ends the next one takes its place, so that the batch stays full until the last ones.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
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
"""Opens a new world for a task."""


@dataclass(frozen=True)
class Request(Generic[K]):
    """An episode to run."""

    key: K  # tells the caller whose it is
    task: str
    seed: int


EpisodeEnd = tuple[Request[K], EpisodeRecord | Exception]
"""A request, and its record or the error that its world raised.

The record's wall_seconds are its share: a decode's time is divided by the episodes that were decoded together.
"""


def run_together(
    decoder: BatchDecoder, requests: Iterable[Request[K]], batch: int, open_world: OpenWorld
) -> Iterator[EpisodeEnd[K]]:
    """Run the episodes, at most `batch` at a time, and yield each as it ends.

    A world is opened when an episode needs one and closed when its task has no episode left. The slots of a batch go to
    different tasks while there are enough of them, because opening a world costs more than resetting one.
    """
    waiting = list(requests)
    slots: list[_Slot[K]] = [_Slot(decoder.new_episode(), open_world) for _ in range(min(batch, len(waiting)))]
    try:
        while True:
            for slot in slots:
                while slot.request is None and waiting:
                    slot.begin(_take(waiting, slot.task))
                    yield from slot.advance(None)
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
                yield from slot.advance(decode)
    finally:
        for slot in slots:
            slot.close()


def _take(waiting: list[Request[K]], task: str) -> Request[K]:
    """Take the next request of a task. If it has none left, take one of the task with the most."""
    counts = Counter(request.task for request in waiting)
    wanted = task if counts[task] else counts.most_common(1)[0][0]
    return waiting.pop(next(i for i, request in enumerate(waiting) if request.task == wanted))


class _Slot(Generic[K]):
    """A slot of the batch: its open world and the episode that runs in it."""

    def __init__(self, state: EpisodeState, open_world: OpenWorld) -> None:
        self.state, self.open_world = state, open_world
        self.task = ""
        self.world: World | None = None
        self.request: Request[K] | None = None

    def begin(self, request: Request[K]) -> None:
        self.request, self.seconds, self.steps = request, 0.0, self._episode(request)

    def _episode(self, request: Request[K]) -> Generator[Observation, DecodeRecord, EpisodeRecord]:
        if self.world is None or self.task != request.task:
            self.close()
            self.world, self.task = self.open_world(request.task), request.task
        return (yield from episode(self.world, self.state, request.seed))

    def advance(self, decode: DecodeRecord | None) -> Iterator[EpisodeEnd[K]]:
        """Execute a decode, None at the beginning, until the next observation. Yield the episode if it ends."""
        began, request = time.perf_counter(), self.request
        assert request is not None
        try:
            self.observation = self.steps.send(decode)  # type: ignore[arg-type]
            self.seconds += time.perf_counter() - began
            return
        except StopIteration as end:
            seconds = self.seconds + time.perf_counter() - began
            result: EpisodeRecord | Exception = dataclasses.replace(end.value, wall_seconds=seconds)
        except Exception as error:  # noqa: BLE001 - one world's failure of any kind must not end the others
            result = error
            self.close()
        self.request = None
        yield request, result

    def close(self) -> None:
        if self.world is not None:
            self.world.close()
        self.task, self.world = "", None
