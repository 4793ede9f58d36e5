"""The 50 tasks of Meta-World v3: names, instructions, difficulty groups, suites.

The public table has the same sentence for push and push-back. The instructions in `tasks.csv`, at most ten lower-case
words each, all differ and describe what the experts do. Join tasks by name, never by index: published tables order them
differently.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from kerv_cli.worlds.task import Task

SUFFIX = "-v3"
DIFFICULTIES = ("easy", "medium", "hard", "very_hard")
"""The groups of published macro averages."""

with Path(__file__).with_name("tasks.csv").open(encoding="utf-8") as _file:
    _rows = sorted((f"{row['task']}{SUFFIX}", row["instruction"], row["difficulty"]) for row in csv.DictReader(_file))

TASKS: Mapping[str, Task] = {row[0]: Task(*row) for row in _rows}
"""All 50 tasks by full name, in alphabetical order."""

_MT10 = (
    "reach push pick-place door-open drawer-open drawer-close button-press-topdown peg-insert-side window-open "
    "window-close"
)

SUITES: Mapping[str, tuple[str, ...]] = {
    "MT10": tuple(f"{task}{SUFFIX}" for task in _MT10.split()),
    "MT50": tuple(TASKS),
}
"""Suite name to full task names."""

NAMES = (*SUITES, *TASKS)
"""Suites and tasks, for completion."""
