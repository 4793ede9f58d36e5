"""Runs episodes in the worlds of this process: one after the other, or several at once.

All settings of a process share weights, datastores and worlds. They do not share frames and decoders: a setting with
the frames of another would decode with warm caches, and a skip's level may follow the episodes of its own block.
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.protocol import Target
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.episode import OnStep, run_episode
from kerv_cli.episodes.policy import batch_decoder_for, clock_for, decoder_for
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.episodes.together import EpisodeEnd, Request, run_together
from kerv_cli.methods.parallel import native_decoder
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.settings import CameraSettings, WorldSettings
from kerv_cli.worlds.spec import World
from kerv_cli.worlds.stress import NO_STRESS, Stress
from kerv_cli.worlds.stress import build as build_stress

K = TypeVar("K")

TOGETHER = 16
"""Episodes that a training's validation decodes together. Their worlds take 1.5 GB if they are drawn."""

_WORLDS = 4  # kept open per process; one that is drawn takes about 90 MB
_opened: OrderedDict[tuple[str, CameraSettings, int], World] = OrderedDict()  # the most recently used one is last


def open_world(task: str, settings: WorldSettings, stress: Stress = NO_STRESS) -> World:
    """Return this process's world for a task, camera and horizon, with the stress of its next episodes.

    The worlds used last stay open.
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
    """Return a new world for a task, which the caller closes."""
    world = spec_of(task).open_world(task, settings.camera, settings.horizon)
    world.stress = stress
    return world


def close_worlds() -> None:
    """Close every open world."""
    while _opened:
        _opened.popitem()[1].close()


class Runner:
    """One setting on one task, with its decoder built and warmed up.

    Episodes may alternate with those of other runners: decoders share no state.
    """

    def __init__(self, settings: RolloutSettings, task: str) -> None:
        self.settings, self.task = settings, task
        self.decoder = decoder_for(settings, task)
        self.stress = build_stress(settings.world.stress)
        self.clock = clock_for(settings, task)
        self._recording = dataclasses.replace(settings.world.camera, size=settings.record_size, supersample=1)

    def episode(self, seed: int, recorded: bool = False, on_step: OnStep | None = None) -> EpisodeRecord:
        """Run the episode of a seed. Its record has frames if `recorded`."""
        world = open_world(self.task, self.settings.world, self.stress)  # another runner may have closed it since
        return run_episode(world, self.decoder, seed, self._recording if recorded else None, self.clock, on_step)


def run_batch(settings: RolloutSettings, requests: Iterable[Request[K]]) -> Iterator[EpisodeEnd[K]]:
    """Run episodes of one setting on any tasks, `rollout.batch` at a time. None is recorded."""
    decoder, world = batch_decoder_for(settings), settings.world
    return run_together(
        decoder, requests, settings.rollout.batch, lambda task: new_world(task, world, build_stress(world.stress))
    )


def is_recorded(settings: RolloutSettings, seed: int) -> bool:
    """Return whether the episode of a seed keeps its frames.

    The first `settings.record` do, or all if it is negative; none of a batch does.
    """
    return settings.rollout.batch == 1 and (settings.record < 0 or seed - settings.seed < settings.record)


def success_of(target: Target, tasks: Iterable[str], seeds: Sequence[int], settings: WorldSettings) -> float:
    """Return the share in [0, 1] of successful episodes over tasks and seeds.

    The target decodes as it was trained to: autoregressively or in parallel.
    """
    decoder = BatchDecoder(native_decoder(target))
    requests = [Request(None, task, seed) for task in tasks for seed in seeds]
    outcomes = []
    for _, result in run_together(decoder, requests, TOGETHER, lambda task: new_world(task, settings)):
        if isinstance(result, Exception):
            raise result
        outcomes.append(result.success)
    return float(np.mean(outcomes))
