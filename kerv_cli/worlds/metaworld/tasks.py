"""The 50 tasks of Meta-World v3: names, instructions and suites.

Meta-World's published instructions are the same for push and push-back. The instructions in `tasks.csv` all differ.
They have at most ten lower-case words and describe what the experts do. Match tasks to published tables by name, not by
position: the tables have other orders.
"""

from __future__ import annotations

import csv
from pathlib import Path

from kerv_cli.worlds import Task

SUFFIX = "-v3"

TASKS: dict[str, Task] = {}  # by full name, in alphabetical order

with Path(__file__).with_name("tasks.csv").open(encoding="utf-8") as _file:
    for _row in csv.DictReader(_file):
        _name = f"{_row['task']}{SUFFIX}"
        TASKS[_name] = Task(_name, _row["instruction"])

_MT10 = (
    "reach push pick-place door-open drawer-open drawer-close button-press-topdown peg-insert-side window-open "
    "window-close"
)

SUITES = {"MT10": tuple(f"{task}{SUFFIX}" for task in _MT10.split()), "MT50": tuple(TASKS)}
