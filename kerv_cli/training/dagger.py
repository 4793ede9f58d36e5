"""What `kerv demos` records: the scripted expert, or a policy whose states the expert labels.

The latter is DAgger (Ross, Gordon, Bagnell 2011). The policy may decode by any method. `method=scout_unverified`
records the states that a drafter's unverified chunks lead to, to train the drafter on.
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
from kerv_cli.methods.compose import Method
from kerv_cli.methods.parallel import native_decoder
from kerv_cli.methods.settings import EXPERT, PolicySettings
from kerv_cli.training.settings import DemosSettings
from kerv_cli.worlds import resolve_tasks, spec_of
from kerv_cli.worlds.demos.recording import DemoConfig
from kerv_cli.worlds.spec import EnvironmentSpec, World


class PolicyActor:
    """Executes whole chunks of a policy, and for a share of the chunks, drawn by task and seed, the expert's actions.

    The decoder is never told that an episode has ended, so that no episode depends on those before it.

    Args:
        decoder_of: Makes the decoder of a task.
        expert_share: Share of chunks in which the expert acts.
    """

    def __init__(self, decoder_of: Callable[[str], Decoder], expert_share: float) -> None:
        self.decoder_of, self.share = functools.cache(decoder_of), expert_share

    def reset(self, world: World, seed: int) -> None:
        """Begin an episode in a world that was reset."""
        self.world = world
        self.random = np.random.default_rng([seed, *world.task.encode()])
        self.actions: deque[NDArray[np.float64]] = deque()  # of the current chunk, not executed yet
        self.expert_steps = 0
        self.executed: NDArray[np.float32] | None = None
        self.decoder = self.decoder_of(world.task)
        self.decoder.reset(world.task, seed, world.end_effector)

    def act(self, label: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action (D,) to execute now: the policy's or, in the expert's chunks, the expert's `label`."""
        if self.executed is not None:
            self.decoder.observe(self.executed, self.world.end_effector)
        if not self.actions and not self.expert_steps:
            if self.random.random() < self.share:
                self.expert_steps = self.decoder.steps
            else:
                self.actions = deque(self.decoder.decode(self.world.observe(self.decoder.cameras)).actions)
        if self.expert_steps:
            self.expert_steps -= 1
            action = label
        else:
            action = self.actions.popleft()
        self.executed = np.asarray(action, dtype=np.float32)
        return np.asarray(action, dtype=np.float64)


@dataclass(frozen=True)
class PolicyActs:
    """Makes the actor of a recording, in the process that records.

    Attributes:
        settings: Settings of the recording.
        sha256: Hash of the target if it decodes as it was trained to, else of the method and of all weights.
    """

    settings: DemosSettings
    sha256: str

    @classmethod
    def of(cls, settings: DemosSettings, spec: EnvironmentSpec) -> PolicyActs:
        """Check the settings' policy for worlds of an environment.

        The recording may show further views after those that the target sees, for a target that will see them.

        Raises:
            UsageError: No such target, frames of another camera, or a method that does not fit.
            CheckpointError: An artifact is missing or damaged, or the policy is of another environment.
        """
        name, world = settings.policy.target, settings.world
        description = _artifacts(settings).description
        description.check_world(name, spec.name, spec.actions, world.camera.size)
        views = [spec.camera_name(view) for view in description.cameras]
        camera = spec.camera_name(world.camera.name)
        if views and not f"{camera}+".startswith(f"{views[0]}+"):
            raise UsageError(
                f"policy.target={name} sees {views[0]}, the recording would show {camera}: set "
                f"world.camera.name={views[0]}, or add further views after it"
            )
        if not _is_plain(settings):
            Method.of(settings).check(description)
        return cls(settings, _hash(settings))

    def __call__(self, config: DemoConfig) -> PolicyActor:
        """Return the actor.

        Raises:
            CheckpointError: The weights are not those that the recording began with.
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
    """Return whether the target decodes as it was trained to: no method and no chunk was chosen."""
    return not settings.chunk and settings.parts() == DemosSettings().parts()


def _artifacts(settings: DemosSettings) -> Artifacts:
    return Artifacts(settings.results, settings.policy, settings.datastore)


def _hash(settings: DemosSettings) -> str:
    if _is_plain(settings):
        return _artifacts(settings).description.sha256
    hashes = _artifacts(settings).check(Method.of(settings).needs)
    return hash_of([hashes, {kind: asdict(part) for kind, part in settings.parts().items()}, settings.chunk])


def recording_of(settings: DemosSettings) -> tuple[DemoConfig, PolicyActs | None]:
    """Return what is recorded, and the policy that moves the robot; None if the expert does.

    Raises:
        UnknownName: No such task.
        UsageError: A target without a policy that acts.
        CheckpointError: No such policy.
    """
    tasks = resolve_tasks(settings.task)
    actor = _actor(settings, tasks[0])
    config = DemoConfig(
        tasks=tasks,
        episodes=settings.episodes,
        first_seed=settings.seed,
        perturbed=settings.perturbed,
        camera=settings.world.camera,
        frame_stride=settings.frame_stride,
        workers=settings.runtime.workers,
        horizon=settings.world.horizon,
        policy=actor.sha256 if actor else "",
        expert_share=settings.expert_share if actor else 0.0,
    )
    return config, actor


def _actor(settings: DemosSettings, task: str) -> PolicyActs | None:
    """Return the policy that moves the robot instead of the expert; None for the expert."""
    target = settings.policy.target
    if settings.policy.kind != EXPERT:
        return PolicyActs.of(settings, spec_of(task))
    if target != PolicySettings().target:
        raise UsageError(f"policy.target={target}: the expert acts, set policy=vision (or state) too")
    return None
