"""Choose who acts while `kerv demos` records: the scripted expert, or a policy.

If a policy acts, the expert labels the states that it visits (DAgger; Ross, Gordon, Bagnell 2011). The policy may
decode with any method. For example, `method=scout_unverified` records the states that a drafter's chunks lead
to without verification, so that the drafter can be trained on them.
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
from kerv_cli.methods.settings import EXPERT, PolicySettings
from kerv_cli.training.settings import DemosSettings
from kerv_cli.worlds import resolve_tasks, spec_of
from kerv_cli.worlds.demos.recording import DemoConfig
from kerv_cli.worlds.spec import EnvironmentSpec, World


class PolicyActor:
    """Chooses the actions that a recording executes: for each chunk, either the policy's or the expert's.

    Task and seed determine in which chunks the expert acts. The decoder is never told whether an episode succeeded, so
    no episode depends on earlier episodes.

    Args:
        decoder_of: Makes the decoder of a task, by the task's name.
        expert_share: Share of the chunks in which the expert acts.
    """

    def __init__(self, decoder_of: Callable[[str], Decoder], expert_share: float) -> None:
        self.decoder_of, self.share = functools.cache(decoder_of), expert_share

    def reset(self, world: World, seed: int) -> None:
        """Begin an episode. The world must have been reset already."""
        self.world = world
        self.random = np.random.default_rng([seed, *world.task.encode()])
        self.actions: deque[NDArray[np.float64]] = deque()  # actions of the current chunk that are not executed yet
        self.expert_steps = 0
        self.executed: NDArray[np.float32] | None = None
        self.decoder = self.decoder_of(world.task)
        self.decoder.reset(world.task, seed, world.end_effector)

    def act(self, label: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action (D,) to execute now.

        Args:
            label: (D,) the expert's action in this state. This action is returned if the expert acts in this chunk.
        """
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
    """A function that makes the `PolicyActor` of a recording. The process that records calls it.

    This object holds the settings of the recording and a hash, but no weights.

    Attributes:
        settings: Settings of the recording.
        sha256: Hash of the method and all its weights.
    """

    settings: DemosSettings
    sha256: str

    @classmethod
    def of(cls, settings: DemosSettings, spec: EnvironmentSpec) -> PolicyActs:
        """Check that the policy can act in an environment. Return the `PolicyActs` of the recording.

        The recording may contain more camera views than the target sees, to train another target on them.

        Args:
            settings: Settings of the recording.
            spec: The environment.

        Raises:
            UsageError: The target does not exist, the recording shows another camera than the target sees, or the
                method does not work with the target.
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
        Method.of(settings).check(description)
        return cls(settings, _hash(settings))

    def __call__(self, config: DemoConfig) -> PolicyActor:
        """Make the actor of a recording.

        Raises:
            CheckpointError: The policy's weights have changed since the recording began.
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
        return Method.of(self.settings).decoder(artifacts.target, artifacts.load, task)


def _artifacts(settings: DemosSettings) -> Artifacts:
    return Artifacts(settings.results, settings.policy, settings.datastore)


def _hash(settings: DemosSettings) -> str:
    hashes = _artifacts(settings).check(Method.of(settings).needs)
    return hash_of([hashes, {kind: asdict(part) for kind, part in settings.parts().items()}, settings.chunk])


def recording_of(settings: DemosSettings) -> tuple[DemoConfig, PolicyActs | None]:
    """Return the description of a recording, and the policy that acts in it. The policy is None if the expert acts.

    Raises:
        UnknownName: A task does not exist.
        UsageError: `policy.target` is set although the expert acts.
        CheckpointError: The policy does not exist.
    """
    tasks, target = resolve_tasks(settings.task), settings.policy.target
    actor = None
    if settings.policy.kind != EXPERT:
        actor = PolicyActs.of(settings, spec_of(tasks[0]))
    elif target != PolicySettings().target:
        raise UsageError(f"policy.target={target}: the expert acts, set policy=vision (or state) too")
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
