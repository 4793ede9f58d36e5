"""DAgger: a policy moves the robot, the expert labels the states that it visits (Ross, Gordon, Bagnell 2011).

The policy decodes by any method. So the states that a drafter's unverified chunks lead to are recorded with
`method=scout_unverified`, for the drafter to be trained on.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.engine.decoder import Decoder
from kerv_cli.episodes.identity import hash_of
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.compose import Method, native_decoder
from kerv_cli.training.settings import DemosSettings
from kerv_cli.worlds.demos.recording import DemoConfig
from kerv_cli.worlds.spec import EnvironmentSpec, World


class PolicyActor:
    """A policy decodes chunks and executes them whole. For a share of the chunks, drawn by task and seed, the expert
    acts instead; then the policy decodes anew. The decoder is never told that an episode has ended: nothing that it
    would remember makes an episode depend on those before it in the same process. decoder_of: task -> its decoder.
    actions: those of the current chunk that are not executed yet."""

    def __init__(self, decoder_of: Callable[[str], Decoder], expert_share: float) -> None:
        self.decoder_of, self.share = functools.cache(decoder_of), expert_share
        self.actions: deque[NDArray[np.float64]] = deque()
        self.expert_steps = 0
        self.executed: NDArray[np.float32] | None = None

    def reset(self, world: World, seed: int) -> None:
        """Begins an episode in a world that was reset."""
        self.world = world
        self.random = np.random.default_rng([seed, *world.task.encode()])
        self.actions.clear()
        self.expert_steps, self.executed = 0, None
        self.decoder = self.decoder_of(world.task)
        self.decoder.reset(world.task, seed, world.end_effector)

    def act(self, label: NDArray[np.float64]) -> NDArray[np.float64]:
        """The action (D,) to execute now, of the policy or, in the expert's chunks, the expert's `label`."""
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
            self.expert_steps = self.decoder.steps
        else:
            self.actions = deque(self.decoder.decode(self.world.observe(self.decoder.cameras)).actions)


@dataclass(frozen=True)
class PolicyActs:
    """Makes the actor of a recording. sha256: of the target, where that decodes as it was trained to; else a hash of
    the method and of all weights."""

    settings: DemosSettings
    sha256: str

    @classmethod
    def of(cls, settings: DemosSettings, spec: EnvironmentSpec) -> PolicyActs:
        """The settings' policy, for worlds of an environment. The recording may show further views behind those that
        the target sees, for a target that will see them.

        Raises:
            UsageError: no such target, frames of another camera, a method that does not fit.
            CheckpointError: an artifact is missing or damaged, or the policy is of another environment.
        """
        name, world = settings.policy.target, settings.world
        description = _artifacts(settings).description
        description.check_world(name, spec.name, spec.actions, world.camera.size)
        views = [spec.camera_name(view) for view in description.cameras]
        camera = spec.camera_name(world.camera.name)
        if views and not f"{camera}+".startswith(f"{views[0]}+"):
            raise UsageError(
                f"policy.target={name} sees {views[0]}, the recording would show {camera}: set "
                f"world.camera.name={views[0]}, or join further views behind it"
            )
        if not _is_plain(settings):
            Method.of(settings).check(description)
        return cls(settings, _hash(settings))

    def __call__(self, config: DemoConfig) -> PolicyActor:
        """The actor, in the process that records.

        Raises:
            CheckpointError: other weights than those that the recording began with.
        """
        torch.set_num_threads(1)
        if _hash(self.settings) != self.sha256:
            raise CheckpointError(
                f"the policy {self.settings.policy.target} has changed since the recording began: record under another "
                "name="
            )
        return PolicyActor(self._decoder, config.expert_share)

    def _decoder(self, task: str) -> Decoder:
        artifacts = _artifacts(self.settings)
        if _is_plain(self.settings):
            return native_decoder(artifacts.target)
        return Method.of(self.settings).decoder(artifacts.target, artifacts.load, task)


def _is_plain(settings: DemosSettings) -> bool:
    """Whether no method and no chunk was chosen: the target decodes as it was trained to."""
    return not settings.chunk and settings.parts() == DemosSettings().parts()


def _artifacts(settings: DemosSettings) -> Artifacts:
    return Artifacts(settings.results, settings.policy, settings.datastore)


def _hash(settings: DemosSettings) -> str:
    if _is_plain(settings):
        return _artifacts(settings).description.sha256
    hashes = _artifacts(settings).check(Method.of(settings).needs)
    return hash_of([hashes, {kind: asdict(part) for kind, part in settings.parts().items()}, settings.chunk])
