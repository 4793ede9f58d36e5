"""The insertion tasks. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping

from kerv_cli.environments.spec import Task

DIFFICULTIES = ("easy", "hard")

TASKS: Mapping[str, Task] = {
    task.name: task
    for task in (
        Task("insert-peg", "turn the peg and push it into the tilted slot", "easy"),
        Task("fetch-peg", "pick up the peg and put it into the slot", "hard"),
    )
}

SUITES: Mapping[str, tuple[str, ...]] = {"INSERTION": tuple(TASKS)}

NAMES = (*SUITES, *TASKS)
"""Suites and tasks, for completion."""
