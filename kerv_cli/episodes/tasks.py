"""The tasks of a rollout, and those that its target was trained on. Importing this file loads no torch."""

from __future__ import annotations

from collections.abc import Iterable

from kerv_cli.base.errors import UsageError
from kerv_cli.episodes.settings import DEFAULT_TASKS, RolloutSettings
from kerv_cli.methods.settings import EXPERT
from kerv_cli.targets.checkpoint import TargetDescription, described
from kerv_cli.targets.folders import find_target
from kerv_cli.worlds import resolve_tasks


def tasks_of(settings: RolloutSettings) -> tuple[str, ...]:
    """Return the full names of a rollout's tasks. By default they are the tasks that its target was trained on.

    Raises:
        UnknownName: A task does not exist.
        CheckpointError: The target's description is damaged.
    """
    return resolve_tasks(settings.task or list(trained_tasks(settings)) or DEFAULT_TASKS)


def trained_tasks(settings: RolloutSettings) -> tuple[str, ...]:
    """Return the full names of the tasks that a rollout's target was trained on.

    Empty for the expert, for a target that does not name its tasks, and for a missing target (`check` reports that).

    Raises:
        CheckpointError: The target's description is damaged.
    """
    if settings.policy.kind == EXPERT:
        return ()
    try:
        folder = find_target(settings.results, settings.policy.target)
    except UsageError:
        return ()
    names = described(folder, "target", TargetDescription).tasks
    return resolve_tasks(names) if names else ()


def unseen_tasks(settings: RolloutSettings, tasks: Iterable[str]) -> list[str]:
    """Return the tasks that the target was not trained on. Empty if the target does not name its training tasks."""
    trained = trained_tasks(settings)
    return [task for task in tasks if trained and task not in trained]
