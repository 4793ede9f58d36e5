"""What `kerv demos` records: the scripted expert, or a policy whose states the expert labels."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.methods.settings import EXPERT, PolicySettings
from kerv_cli.training.settings import DemosSettings
from kerv_cli.worlds import resolve_tasks, spec_of
from kerv_cli.worlds.demos.recording import DemoConfig

if TYPE_CHECKING:
    from kerv_cli.training.dagger import PolicyActs


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
        from kerv_cli.training.dagger import PolicyActs

        return PolicyActs.of(settings, spec_of(task))
    if target != PolicySettings().target:
        raise UsageError(f"policy.target={target}: the expert acts, set policy=vision (or state) too")
    return None
