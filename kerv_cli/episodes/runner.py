"""Run episodes in the worlds (open environments) of this process: one after the other, or several at once.

Settings in a process share weights, datastores and worlds. Each has its own decoder and renders its own images, so
that no setting becomes faster through the caches of another.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections import Counter, OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Follower
from kerv_cli.engine.decoder import BatchDecoder
from kerv_cli.engine.protocol import Target
from kerv_cli.engine.record import DecodeRecord, EpisodeRecord
from kerv_cli.episodes.episode import episode, run_episode
from kerv_cli.episodes.policy import clock_for, decoder_for, method_decoder
from kerv_cli.episodes.remote import close_servers
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.unverified import native_decoder
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.settings import CameraSettings, WorldSettings
from kerv_cli.worlds.spec import World
from kerv_cli.worlds.stress import NO_STRESS, Stress
from kerv_cli.worlds.stress import build as build_stress

K = TypeVar("K")
OpenWorld = Callable[[str], World]  # opens a new world for a task

# Number of episodes that run at once in the validation of a training. With rendering, their worlds take 1.5 GB.
TOGETHER = 16

_WORLDS = 4  # kept open per process; one with rendering takes about 90 MB
_opened: OrderedDict[tuple[str, CameraSettings, int], World] = OrderedDict()  # the most recently used one is last


def open_world(task: str, settings: WorldSettings, stress: Stress = NO_STRESS) -> World:
    """Return this process's world (an open environment) for a task. The most recently used worlds stay open."""
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
    while _opened:
        _opened.popitem()[1].close()
    close_servers()


class Runner:
    """Runs episodes of one setting (a method with all its options) on one task. The decoder is built only once.

    The episodes may alternate with episodes of other runners, because decoders share no state. With `save`, the
    episodes that the settings say to record are recorded and passed to `save`.
    """

    def __init__(
        self, settings: RolloutSettings, task: str, save: Callable[[EpisodeRecord], object] | None = None
    ) -> None:
        self.settings, self.task, self.save = settings, task, save
        self.decoder = decoder_for(settings, task)
        self.stress = build_stress(settings.world.stress)
        self.clock = clock_for(settings, spec_of(task))
        self._recording = dataclasses.replace(settings.world.camera, size=settings.record_size, supersample=1)

    def episode(self, seed: int, recorded: bool = False) -> EpisodeRecord:
        recorded = recorded or (self.save is not None and is_recorded(self.settings, seed))
        world = open_world(self.task, self.settings.world, self.stress)  # another runner may have closed it since
        record = run_episode(world, self.decoder, seed, self._recording if recorded else None, self.clock)
        if self.save is None:
            return record
        if record.frames:
            self.save(record)
        return dataclasses.replace(record, frames={}, places={})


@dataclass(frozen=True)
class Request(Generic[K]):
    """An episode to run: a task and a seed, with a key by which the caller recognises it."""

    key: K  # the caller's, returned with the result
    task: str
    seed: int


# A request, with the record of its episode or the error that ended the episode.
EpisodeEnd = tuple[Request[K], EpisodeRecord | Exception]


def run_together(
    decoder: BatchDecoder, requests: Iterable[Request[K]], batch: int, open_world: OpenWorld
) -> Iterator[EpisodeEnd[K]]:
    """Run several episodes at once. Yield each request when its episode ends, with the record or the error.

    The batch has up to `batch` slots. Each slot runs one episode after another. A slot opens a world for an episode,
    and keeps this world while its task has episodes left, because opening a world takes longer than resetting it.
    """
    waiting = list(requests)
    ended: list[EpisodeEnd[K]] = []
    states = [decoder.new_episode() for _ in range(min(batch, len(waiting)))]
    slots = [_one_after_another(state, waiting, ended, open_world) for state in states]
    decodes: dict[int, Any] = dict.fromkeys(range(len(slots)))  # None starts a slot's first episode
    try:
        while decodes:
            observations: dict[int, Observation] = {}
            for slot, decode in decodes.items():
                with contextlib.suppress(StopIteration):
                    observations[slot] = slots[slot].send(decode)
                while ended:
                    request, result = ended.pop(0)
                    if not isinstance(result, Exception):
                        result = dataclasses.replace(result, wall_seconds=result.wall_seconds / len(slots))
                    yield request, result
            decodes = {}
            if observations:
                found = decoder.decode([states[slot] for slot in observations], list(observations.values()))
                decodes = dict(zip(observations, found, strict=True))
    finally:
        for running in slots:
            running.close()


def _one_after_another(
    state: Follower, waiting: list[Request[K]], ended: list[EpisodeEnd[K]], open_world: OpenWorld
) -> Generator[Observation, DecodeRecord, None]:
    world: World | None = None
    try:
        while waiting:
            request = _take(waiting, world.task if world else "")
            result: EpisodeRecord | Exception
            try:
                if world is not None and world.task != request.task:
                    world.close()
                    world = None
                world = world or open_world(request.task)
                result = yield from episode(world, state, request.seed)
            except Exception as error:  # noqa: BLE001 - one world's failure of any kind must not end the others
                result = error
                if world is not None:
                    world.close()
                world = None
            ended.append((request, result))
    finally:
        if world is not None:
            world.close()


def _take(waiting: list[Request[K]], task: str) -> Request[K]:
    tasks = [request.task for request in waiting]
    wanted = task if task in tasks else Counter(tasks).most_common(1)[0][0]
    return waiting.pop(tasks.index(wanted))


def run_batch(settings: RolloutSettings, requests: Iterable[Request[K]]) -> Iterator[EpisodeEnd[K]]:
    decoder, world = BatchDecoder(method_decoder(settings)), settings.world
    return run_together(
        decoder, requests, settings.rollout.batch, lambda task: new_world(task, world, build_stress(world.stress))
    )


def is_recorded(settings: RolloutSettings, seed: int) -> bool:
    return settings.rollout.batch == 1 and (settings.record < 0 or seed - settings.seed < settings.record)


def success_of(target: Target, tasks: Iterable[str], seeds: Sequence[int], settings: WorldSettings) -> float:
    """Run one episode per task and seed, and return the share of successes. The target decodes as it was trained to."""
    decoder = BatchDecoder(native_decoder(target))
    requests = [Request(None, task, seed) for task, seed in itertools.product(tasks, seeds)]
    outcomes = []
    for _, result in run_together(decoder, requests, TOGETHER, lambda task: new_world(task, settings)):
        if isinstance(result, Exception):
            raise result
        outcomes.append(result.success)
    return float(np.mean(outcomes))
