"""Run episodes in the worlds (open environments) of this process.

Settings in a process share weights, datastores and worlds. Each has its own decoder and renders its own images, so
that no setting becomes faster through the caches of another.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from kerv_cli.engine.protocol import Target
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.episode import run_episode
from kerv_cli.episodes.policy import clock_for, decoder_for
from kerv_cli.episodes.remote import close_servers
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.unverified import native_decoder
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.settings import CameraSettings, WorldSettings
from kerv_cli.worlds.spec import World
from kerv_cli.worlds.stress import NO_STRESS, Stress
from kerv_cli.worlds.stress import build as build_stress

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


def is_recorded(settings: RolloutSettings, seed: int) -> bool:
    return settings.record < 0 or seed - settings.seed < settings.record


def success_of(target: Target, tasks: Iterable[str], seeds: Sequence[int], settings: WorldSettings) -> float:
    """Run one episode per task and seed, and return the share of successes. The target decodes as it was trained to."""
    decoder = native_decoder(target)
    try:
        every = itertools.product(tasks, seeds)
        return float(np.mean([run_episode(open_world(task, settings), decoder, seed).success for task, seed in every]))
    finally:
        close_worlds()
