"""DAgger: a target moves the robot, the expert labels the states that it visits (Ross, Gordon, Bagnell 2011)."""

from __future__ import annotations

import functools
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.places import find_target
from kerv_cli.base.settings import WorldSettings
from kerv_cli.engine.protocol import Target
from kerv_cli.methods.compose import native_decoder
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.worlds.demos.recording import DemoConfig
from kerv_cli.worlds.spec import EnvironmentSpec, World


class TargetActor:
    """A target decodes chunks autoregressively (a parallel one in its one pass) and executes them whole. For a share of
    the chunks, drawn by task and seed, the expert acts instead; then the target decodes anew. actions: those of the
    current chunk that are not executed yet."""

    def __init__(self, target: Target, expert_share: float) -> None:
        self.decoder = native_decoder(target)
        self.chunk, self.share = target.chunk, expert_share
        self.actions: deque[NDArray[np.float64]] = deque()
        self.expert_steps = 0
        self.executed: NDArray[np.float32] | None = None

    def reset(self, world: World, seed: int) -> None:
        """See `Actor.reset`."""
        self.world = world
        self.random = np.random.default_rng([seed, *world.task.encode()])
        self.actions.clear()
        self.expert_steps, self.executed = 0, None
        self.decoder.reset(world.task, seed, world.end_effector)

    def act(self, label: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Actor.act`."""
        if self.executed is not None:
            self.decoder.observe(self.executed, self.world.end_effector)
        if not self.actions and not self.expert_steps:
            self._decide()
        if self.expert_steps:
            self.expert_steps -= 1
            action = label
        else:
            action = self.actions.popleft()
        self.executed = np.asarray(action, dtype=np.float32)
        return np.asarray(action, dtype=np.float64)

    def _decide(self) -> None:
        if self.random.random() < self.share:
            self.expert_steps = self.chunk
        else:
            self.actions = deque(self.decoder.decode(self.world.observe(self.decoder.cameras)).actions)


@functools.lru_cache(maxsize=1)
def _target_in(folder: Path, sha256: str) -> Target:
    torch.set_num_threads(1)
    target: Target
    target, description = load_target(folder)
    if description.sha256 != sha256:
        raise CheckpointError(
            f"the target in {folder} has changed since the recording began: record under another name="
        )
    return target


@dataclass(frozen=True)
class TargetActs:
    """Makes the actor of a recording. folder, sha256: of the target."""

    folder: Path
    sha256: str

    @classmethod
    def of(cls, results: str, name: str, spec: EnvironmentSpec, world: WorldSettings) -> TargetActs:
        """The target of that name, for worlds of an environment. The recording may show further views behind those
        that the target sees, for a target that will see them.

        Raises:
            UsageError: no such target, frames of another camera, or as `check_world`. CheckpointError: it is damaged,
                or as `check_world`.
        """
        folder = find_target(results, name)
        description = read_target(folder)
        description.check_world(name, spec.name, spec.actions, world.camera.size)
        views = [spec.camera_name(view) for view in description.cameras]
        camera = spec.camera_name(world.camera.name)
        if views and not f"{camera}+".startswith(f"{views[0]}+"):
            raise UsageError(
                f"policy.target={name} sees {views[0]}, the recording would show {camera}: set "
                f"world.camera.name={views[0]}, or join further views behind it"
            )
        return cls(folder, description.sha256)

    def __call__(self, config: DemoConfig) -> TargetActor:
        """The actor, in the process that records."""
        return TargetActor(_target_in(self.folder, self.sha256), config.expert_share)
