"""Demonstrations of some of the target's tasks, or of one side of the initial range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset

ALL, HALF = "all", "half"


def subset(dataset: DemoDataset, tasks: Sequence[str], starts: str = ALL) -> DemoDataset:
    """The dataset with only the episodes of `tasks` (tasks and suites; none: all), and with starts=half only those that
    begin on one side.

    Raises:
        UnknownName: no such task. CheckpointError: the dataset has none of a task.
    """
    if not tasks and starts == ALL:
        return dataset
    names = resolve_tasks(tasks) if tasks else tuple(dataset.manifest.tasks)
    missing = [task for task in names if task not in dataset.manifest.tasks]
    if missing:
        raise CheckpointError(f"the demonstrations in {dataset.path} hold no episode of {missing[0]}")
    chosen = [index for index, entry in enumerate(dataset.episodes) if entry.task in names]
    if starts == HALF:
        chosen = _one_side(dataset, chosen)
    return replace(dataset, episodes=[dataset.episodes[index] for index in chosen])


def _one_side(dataset: DemoDataset, chosen: Sequence[int]) -> list[int]:
    """The episodes in which the observation's first place, as a rule the object, begins at or below its median x over
    the chosen episodes of the task."""
    places = dataset.manifest.observation.places
    if not places:
        raise UsageError("starts=half: these demonstrations name no place that begins on one side")
    begins = {index: float(dataset.load(index).states[0][places[0].first]) for index in chosen}
    by_task: dict[str, list[float]] = {}
    for index, x in begins.items():
        by_task.setdefault(dataset.episodes[index].task, []).append(x)
    medians = {task: float(np.median(values)) for task, values in by_task.items()}
    return [index for index, x in begins.items() if x <= medians[dataset.episodes[index].task]]
