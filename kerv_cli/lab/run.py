"""Episodes of one setting on one task, in the worlds of this process."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np

from kerv_cli.base.settings import CameraSettings, RolloutSettings, WorldSettings
from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab.episode import ActionDecoder, run_episode
from kerv_cli.lab.policy import batch_decoder_for, clock_for, decoder_for
from kerv_cli.lab.together import EpisodeEnd, Request, run_together
from kerv_cli.methods.compose import own_decoder
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.camera import CameraConfig
from kerv_cli.worlds.spec import World
from kerv_cli.worlds.stress import NO_STRESS, Stress
from kerv_cli.worlds.stress import build as build_stress
from kerv_cli.worlds.world import EpisodeWorld

K = TypeVar("K", bound=Hashable)


def camera_config(settings: CameraSettings) -> CameraConfig:
    """The camera of these settings. Raises UsageError for impossible numbers."""
    return CameraConfig(**dataclasses.asdict(settings))


TOGETHER = 16
"""Episodes that a training's validation decodes together. Their worlds take 1.5 GB where they are drawn."""

_WORLDS = 4  # kept open per process: one that is drawn takes about 90 MB
_opened: OrderedDict[tuple[str, CameraConfig, int], World] = OrderedDict()  # the most recently used one is last


def open_world(task: str, settings: WorldSettings, stress: Stress = NO_STRESS) -> World:
    """This process's world for a task, camera and horizon, shared by all settings that agree in them. The worlds used
    last stay open. stress: the shift of its next episodes."""
    key = task, camera_config(settings.camera), settings.horizon
    if key not in _opened:
        _opened[key] = spec_of(task).open_world(*key)
    _opened.move_to_end(key)
    while len(_opened) > _WORLDS:
        _opened.popitem(last=False)[1].close()
    return _stressed(_opened[key], stress)


def new_world(task: str, settings: WorldSettings, stress: Stress = NO_STRESS) -> World:
    """A new world for a task, which the caller closes; see `open_world`."""
    return _stressed(spec_of(task).open_world(task, camera_config(settings.camera), settings.horizon), stress)


def _stressed(world: World, stress: Stress) -> World:
    if isinstance(world, EpisodeWorld):
        world.stress = stress
    return world


def close_worlds() -> None:
    """Closes every open world."""
    while _opened:
        _opened.popitem()[1].close()


class Runner:
    """One setting on one task, with its decoder built and warmed up. Episodes may alternate with those of other
    runners: no state is shared between decoders.

    Raises:
        UsageError, CheckpointError: the setting cannot run; see `policy.check`.
    """

    def __init__(self, settings: RolloutSettings, task: str) -> None:
        self.settings, self.task = settings, task
        self.decoder = decoder_for(settings, task)
        self.stress = build_stress(settings.world.stress)
        self.clock = clock_for(settings, task)
        camera = camera_config(settings.world.camera)
        self._recording = dataclasses.replace(camera, size=settings.record_size, supersample=1)
        self.on_step: Callable[[int], None] | None = None  # told the number of executed control steps, for progress

    def episode(self, seed: int, recorded: bool = False) -> EpisodeRecord:
        """Runs the episode of a seed; its record has frames where it is recorded."""
        world = open_world(self.task, self.settings.world, self.stress)  # another runner may have closed it since
        decoder = self.decoder if self.on_step is None else Watched(self.decoder, self.on_step)
        return run_episode(world, decoder, seed, self._recording if recorded else None, self.clock)


class Watched:
    """A decoder whose executed control steps are counted, outside the timing. on_step: told the number so far."""

    def __init__(self, decoder: ActionDecoder, on_step: Callable[[int], None]) -> None:
        self.decoder, self.on_step, self.steps = decoder, on_step, 0
        self.decode, self.watcher = decoder.decode, getattr(decoder, "watcher", None)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those of the decoder."""
        return self.decoder.cameras

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """Begins an episode."""
        self.steps = 0
        self.decoder.reset(task, seed, end_effector)

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """Tells the decoder, then counts."""
        self.decoder.observe(action, end_effector)
        self.steps += 1
        self.on_step(self.steps)

    def finish(self, success: bool) -> None:
        """Tells the decoder."""
        self.decoder.finish(success)


def run_batch(settings: RolloutSettings, requests: Iterable[Request[K]]) -> Iterator[EpisodeEnd[K]]:
    """Runs episodes of one setting on any tasks, `rollout.batch` at a time; see `run_together`. None is recorded.

    Raises:
        UsageError, CheckpointError: the setting cannot run; see `policy.check`.
    """

    def opened(task: str) -> World:
        return new_world(task, settings.world, build_stress(settings.world.stress))

    return run_together(batch_decoder_for(settings), requests, settings.rollout.batch, opened)


def run_task(settings: RolloutSettings, task: str, seeds: Sequence[int]) -> Iterator[EpisodeRecord]:
    """Runs one setting on one task, seed by seed; `is_recorded` says which episodes keep frames."""
    runner = Runner(settings, task)
    for seed in seeds:
        yield runner.episode(seed, is_recorded(settings, seed))


def is_recorded(settings: RolloutSettings, seed: int) -> bool:
    """Whether the episode of a seed keeps its frames: the first `settings.record`, or all for a negative number; none
    of a batch."""
    if settings.rollout.batch > 1:
        return False
    return settings.record < 0 or seed - settings.seed < settings.record


def success_of(target: Any, tasks: Iterable[str], seeds: Sequence[int], settings: WorldSettings) -> float:
    """Share in [0, 1] of successful episodes over tasks and seeds, decoded as the target was trained to,
    autoregressively or in parallel, TOGETHER at a time."""
    decoder = BatchDecoder(own_decoder(target))
    requests = [Request(None, task, seed) for task in tasks for seed in seeds]
    outcomes = []
    for end in run_together(decoder, requests, TOGETHER, lambda task: new_world(task, settings)):
        if isinstance(end.result, Exception):
            raise end.result
        outcomes.append(end.result.success)
    return float(np.mean(outcomes))
