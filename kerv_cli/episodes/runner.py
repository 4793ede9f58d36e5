"""Runs episodes in the worlds (open environments) of this process: one after the other, or several at once.

All settings in a process share weights, datastores and worlds, but each has its own rendered images and decoder.
Shared images would give a setting warm caches, and a skip rule's threshold may depend on the episodes before it.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.chunk import EpisodeState
from kerv_cli.engine.protocol import Target
from kerv_cli.engine.record import DecodeRecord, EpisodeRecord
from kerv_cli.episodes.episode import episode, run_episode
from kerv_cli.episodes.policy import batch_decoder_for, clock_for, decoder_for
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.parallel import native_decoder
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.settings import CameraSettings, WorldSettings
from kerv_cli.worlds.spec import World
from kerv_cli.worlds.stress import NO_STRESS, Stress
from kerv_cli.worlds.stress import build as build_stress

K = TypeVar("K")
OpenWorld = Callable[[str], World]
"""Opens a new world for a task."""

TOGETHER = 16
"""Episodes that run at once in the validation of a training. With rendering, their worlds take 1.5 GB."""

_WORLDS = 4  # kept open per process; one with rendering takes about 90 MB
_opened: OrderedDict[tuple[str, CameraSettings, int], World] = OrderedDict()  # the most recently used one is last


def open_world(task: str, settings: WorldSettings, stress: Stress = NO_STRESS) -> World:
    """Return this process's world (an open environment) for a task. The most recently used worlds stay open.

    Args:
        task: Name of the task.
        settings: Camera and horizon.
        stress: Disturbance in the next episodes.
    """
    spec = spec_of(task)
    key = task, spec.camera(settings.camera), settings.horizon
    if key not in _opened:
        _opened[key] = spec.open_world(*key)
    _opened.move_to_end(key)
    while len(_opened) > _WORLDS:
        _opened.popitem(last=False)[1].close()
    _opened[key].stress = stress
    return _opened[key]


def new_world(task: str, settings: WorldSettings, stress: Stress = NO_STRESS) -> World:
    """Open one more world (environment) for a task. The caller must close it."""
    world = spec_of(task).open_world(task, settings.camera, settings.horizon)
    world.stress = stress
    return world


def close_worlds() -> None:
    """Close every world that `open_world` keeps open."""
    while _opened:
        _opened.popitem()[1].close()


class Runner:
    """Runs episodes of one setting (a method with all its options) on one task. Its decoder is built only once.

    Its episodes may alternate with those of other runners, because decoders share no state.
    """

    def __init__(self, settings: RolloutSettings, task: str) -> None:
        self.settings, self.task = settings, task
        self.decoder = decoder_for(settings, task)
        self.stress = build_stress(settings.world.stress)
        self.clock = clock_for(settings, task)
        self._recording = dataclasses.replace(settings.world.camera, size=settings.record_size, supersample=1)

    def episode(self, seed: int, recorded: bool = False) -> EpisodeRecord:
        """Run one episode, and return its record.

        Args:
            seed: Seed of the initial state.
            recorded: Whether the record keeps images.
        """
        world = open_world(self.task, self.settings.world, self.stress)  # another runner may have closed it since
        return run_episode(world, self.decoder, seed, self._recording if recorded else None, self.clock)


@dataclass(frozen=True)
class Request(Generic[K]):
    """An episode to run: a task and a seed, with a key by which the caller recognises it."""

    key: K  # the caller's, returned with the result
    task: str
    seed: int


EpisodeEnd = tuple[Request[K], EpisodeRecord | Exception]
"""A request, with the record of its episode or the error that its world raised.

The record's `wall_seconds` contain only the episode's share of a batch: a decode's time divided by its episodes.
"""


def run_together(
    decoder: BatchDecoder, requests: Iterable[Request[K]], batch: int, open_world: OpenWorld
) -> Iterator[EpisodeEnd[K]]:
    """Run several episodes at once. Yield each request when its episode ends, with the record or the error.

    A world is opened when an episode needs one, and closed when its task has no episodes left. The places in the batch
    go to different tasks if possible, because opening a world takes longer than resetting one.

    Args:
        decoder: Decodes the observations of all running episodes together.
        requests: The episodes to run.
        batch: Maximum number of episodes that run at the same time.
        open_world: Opens a world for a task.
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
    """Remove and return a request of `task`. If it has none, take one of the task with the most requests."""
    counts = Counter(request.task for request in waiting)
    wanted = task if counts[task] else counts.most_common(1)[0][0]
    return waiting.pop(next(i for i, request in enumerate(waiting) if request.task == wanted))


class _Slot(Generic[K]):
    """One place in the batch: an open world and the episode that runs in it."""

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
        """Execute a decode's actions until the next observation. Yield the request and its result if the episode ends.

        Args:
            decode: Record with the actions; None to start the episode.
        """
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


def run_batch(settings: RolloutSettings, requests: Iterable[Request[K]]) -> Iterator[EpisodeEnd[K]]:
    """Run episodes of one setting, `rollout.batch` at a time, without recording images.

    Args:
        settings: The rollout's settings.
        requests: The episodes to run, of any tasks.
    """
    decoder, world = batch_decoder_for(settings), settings.world
    return run_together(
        decoder, requests, settings.rollout.batch, lambda task: new_world(task, world, build_stress(world.stress))
    )


def is_recorded(settings: RolloutSettings, seed: int) -> bool:
    """Return whether images of the episode with this seed are recorded.

    They are for the first `settings.record` episodes of a task, or for all if it is negative. In a batch, never.
    """
    return settings.rollout.batch == 1 and (settings.record < 0 or seed - settings.seed < settings.record)


def success_of(target: Target, tasks: Iterable[str], seeds: Sequence[int], settings: WorldSettings) -> float:
    """Return the share in [0, 1] of successful episodes, over all pairs of a task and a seed.

    The target decodes as it was trained to, autoregressively or in parallel.
    """
    decoder = BatchDecoder(native_decoder(target))
    requests = [Request(None, task, seed) for task in tasks for seed in seeds]
    outcomes = []
    for _, result in run_together(decoder, requests, TOGETHER, lambda task: new_world(task, settings)):
        if isinstance(result, Exception):
            raise result
        outcomes.append(result.success)
    return float(np.mean(outcomes))
