"""The tasks of LIBERO's four suites of ten tasks, and of LIBERO-PRO's changed versions of these suites.

`tasks.csv` has a row per task. It gives the task's file in the benchmark, and the instructions of the versions `task`
(another goal) and `lan` (other words). All other instructions are made from the file's name.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

from kerv_cli.worlds import Task

# control steps of an episode in each suite, as in OpenVLA's and openpi's evaluation
HORIZONS = {"spatial": 220, "object": 280, "goal": 300, "10": 520}
# endings of suites and tasks: the benchmark's own, then LIBERO-PRO's other places, looks, goals and words
CHANGES = ("", "_swap", "_object", "_task", "_lan")

TASKS: dict[str, Task] = {}
FILES: dict[str, tuple[str, str]] = {}  # folder and name of a task's files, without endings
SUITES: dict[str, tuple[str, ...]] = {}

with Path(__file__).with_name("tasks.csv").open(encoding="utf-8") as _file:
    _rows = list(csv.DictReader(_file))

for _change in CHANGES:
    for _row in _rows:
        _name, _group = _row["name"] + _change, _row["suite"] + _change
        _said = re.sub(r"^[A-Z_]+_SCENE\d+_", "", _row["file"]).replace("_", " ")
        _said = _row.get(_change[1:]) or _said
        TASKS[_name] = Task(_name, _said, HORIZONS[_row["suite"]], _group == "spatial")
        FILES[_name] = f"libero_{_group}", _row["file"]
        SUITES[f"LIBERO_{_group}".upper()] = (*SUITES.get(f"LIBERO_{_group}".upper(), ()), _name)
