"""A task, apart from the rest of an environment: completion lists tasks without importing numpy."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Task:
    """One manipulation task.

    Attributes:
        name: Unique over all environments.
        instruction: Sentence that the policy reads.
        difficulty: Group of tasks that tables average together.
    """

    name: str
    instruction: str
    difficulty: str
