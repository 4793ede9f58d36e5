"""A task's name, instruction and difficulty. Shell completion can list tasks from here without importing numpy."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Task:
    """One manipulation task.

    Attributes:
        name: Full name. No other environment has a task with this name.
        instruction: Sentence that the policy reads.
        difficulty: Name of a group of tasks. Tables also show averages over these groups.
    """

    name: str
    instruction: str
    difficulty: str
