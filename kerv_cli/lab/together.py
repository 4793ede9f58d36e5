"""Runs several episodes at once in one process: each in a world of its own, all of them decoded together.

As soon as an episode ends the next one begins in its place, so that the batch stays full until the last ones.
"""

from __future__ import annotations

import dataclasses
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import BatchDecoder, Lane
from kerv_cli.engine.record import DecodeRecord, EpisodeRecord
from kerv_cli.lab.episode import episode
from kerv_cli.worlds.spec import World

K = TypeVar("K", bound=Hashable)
OpenWorld = Callable[[str], World]
"""Task -> a new world."""


@dataclass(frozen=True)
class Wanted(Generic[K]):
    """An episode to run. key: whose it is, for the caller."""

    key: K
    task: str
    seed: int


@dataclass(frozen=True)
class Ended(Generic[K]):
    """An episode that was run. result: its record, or the error that its world raised. The record's wall_seconds are
    its share of the time: that of a decode is divided by the episodes that were decoded together."""

    wanted: Wanted[K]
    result: EpisodeRecord | Exception


def run_together(
    decoder: BatchDecoder, wanted: Iterable[Wanted[K]], batch: int, open_world: OpenWorld
) -> Iterator[Ended[K]]:
    """Runs the episodes, at most `batch` at a time, and yields each as it ends.

    A world is opened when an episode needs one and closed when its task has no episode left: the places of a batch go
    to different tasks as long as there are enough of them, because a world costs more than a reset.
    """
    waiting = _Waiting(wanted)
    places: list[_Place[K]] = [_Place(decoder.lane(), open_world) for _ in range(min(batch, waiting.count))]
    try:
        while True:
            for place in places:
                while place.asked is None and waiting.count:
                    yield from place.begin(waiting.take(place.task))
                if place.asked is None:
                    place.close()
            live = [place for place in places if place.asked is not None]
            if not live:
                return
            began = time.perf_counter()
            decodes = decoder.decode([place.lane for place in live], [place.observation for place in live])
            share = (time.perf_counter() - began) / len(live)
            for place, decode in zip(live, decodes, strict=True):
                place.seconds += share
                yield from place.go_on(decode)
    finally:
        for place in places:
            place.close()


class _Waiting(Generic[K]):
    """Episodes that have not begun, by task."""

    def __init__(self, wanted: Iterable[Wanted[K]]) -> None:
        self.by_task: OrderedDict[str, deque[Wanted[K]]] = OrderedDict()
        for one in wanted:
            self.by_task.setdefault(one.task, deque()).append(one)
        self.count = sum(map(len, self.by_task.values()))

    def take(self, task: str) -> Wanted[K]:
        """The next one of this task; where it has none, of the task with the most left."""
        if not self.by_task.get(task):
            task = max(self.by_task, key=lambda name: len(self.by_task[name]))
        self.count -= 1
        return self.by_task[task].popleft()


class _Place(Generic[K]):
    """A place of the batch: the world that is open in it and the episode that runs there. seconds: that it took."""

    def __init__(self, lane: Lane, open_world: OpenWorld) -> None:
        self.lane, self.open_world = lane, open_world
        self.task, self.seconds = "", 0.0
        self.world: World | None = None
        self.asked: Wanted[K] | None = None
        self.steps: Generator[Observation, DecodeRecord, EpisodeRecord] | None = None

    def begin(self, wanted: Wanted[K]) -> Iterator[Ended[K]]:
        """Begins an episode; yields it where it ends at once."""
        self.asked, self.seconds = wanted, 0.0
        yield from self._timed(self._first)

    def go_on(self, decode: DecodeRecord) -> Iterator[Ended[K]]:
        """Executes a decode; yields the episode where it has ended."""
        yield from self._timed(lambda: self._steps().send(decode))

    def close(self) -> None:
        """Closes the world."""
        if self.world is not None:
            self.world.close()
        self.world, self.task = None, ""

    def _first(self) -> Observation:
        assert self.asked is not None
        if self.task != self.asked.task:
            self.close()
            self.world, self.task = self.open_world(self.asked.task), self.asked.task
        assert self.world is not None
        self.steps = episode(self.world, self.lane, self.asked.seed)
        return next(self.steps)

    def _steps(self) -> Generator[Observation, DecodeRecord, EpisodeRecord]:
        assert self.steps is not None
        return self.steps

    def _timed(self, step: Callable[[], Observation]) -> Iterator[Ended[K]]:
        """Runs the episode on to its next observation, or yields its end."""
        began, asked = time.perf_counter(), self.asked
        assert asked is not None
        try:
            self.observation = step()
            self.seconds += time.perf_counter() - began
            return
        except StopIteration as end:
            self.seconds += time.perf_counter() - began
            result: EpisodeRecord | Exception = dataclasses.replace(end.value, wall_seconds=self.seconds)
        except Exception as error:  # noqa: BLE001 - one world's failure of any kind must not end the others
            result = error
            self.close()
        self.asked = self.steps = None
        yield Ended(asked, result)
