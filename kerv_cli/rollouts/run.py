"""Episodes of one method on one task, seed by seed, in this process's one world."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from kerv_cli.decoding.decoder import Decoder
from kerv_cli.decoding.record import EpisodeRecord
from kerv_cli.environments import spec_of
from kerv_cli.environments.camera import CameraConfig
from kerv_cli.environments.spec import World
from kerv_cli.rollouts.assemble import episode_decoder, warm_up
from kerv_cli.rollouts.episode import ActionDecoder, Recording, run_episode
from kerv_cli.rollouts.expert import ExpertDecoder
from kerv_cli.rollouts.policy import is_expert, load_policy
from kerv_cli.settings import CameraSettings, MethodSettings, RolloutSettings, WorldSettings
from kerv_cli.targets.protocol import Target


def camera_config(settings: CameraSettings) -> CameraConfig:
    return CameraConfig(**dataclasses.asdict(settings))


@functools.lru_cache(maxsize=1)
def _world(task: str, camera: CameraConfig, horizon: int) -> World:
    return spec_of(task).open_world(task, camera, horizon)


_opened: list[World] = []


def open_world(task: str, settings: WorldSettings) -> World:
    """This process's world for `task`; only one is kept, fifty would take 1.2 GB."""
    world = _world(task, camera_config(settings.camera), settings.horizon)
    for other in [w for w in _opened if w is not world]:
        other.close()
        _opened.remove(other)
    if world not in _opened:
        _opened.append(world)
    return world


def close_worlds() -> None:
    _world.cache_clear()
    while _opened:
        _opened.pop().close()


def run_task(settings: RolloutSettings, task: str, seeds: Sequence[int]) -> Iterator[EpisodeRecord]:
    """One method on one task, seed by seed. The first `settings.record` episodes keep frames for their .rrd."""
    world = open_world(task, settings.world)
    decoder: ActionDecoder = ExpertDecoder()
    if not is_expert(settings):
        decoded = episode_decoder(load_policy(settings), settings, task)
        warm_up(decoded, task, settings.world.camera.size)
        decoder = decoded
    logged = dataclasses.replace(camera_config(settings.world.camera), size=settings.record_size, supersample=1)
    for number, seed in enumerate(seeds):
        recorded = settings.record < 0 or number < settings.record
        yield run_episode(world, decoder, seed, Recording(logged if recorded else None))


def success_of(target: Target, tasks: Iterable[str], seeds: Sequence[int], settings: WorldSettings) -> float:
    """Share of successful AR episodes over tasks and seeds."""
    decoder, outcomes = Decoder(target, MethodSettings()), []
    for task in tasks:
        world = open_world(task, settings)
        outcomes += [run_episode(world, decoder, seed).success for seed in seeds]
    close_worlds()
    return float(np.mean(outcomes))
