"""plan.yaml: a study's settings and cells."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import yaml

from kerv_cli.studies.plan import Cell, make_cell, parse_seeds, seeds_text


@dataclass(frozen=True)
class StudyPlan:
    """A study and its cells, in the order in which they run."""

    name: str
    title: str
    baseline: str  # label that the others are compared with
    axis: str  # config key of the plots' x axis; empty where there is none
    cells: tuple[Cell, ...]
    note: str = ""  # what to see

    @property
    def labels(self) -> list[str]:
        """Labels in the order of the plan."""
        return list(dict.fromkeys(cell.label for cell in self.cells))


def plan_text(plan: StudyPlan) -> str:
    """The plan as YAML: every label's settings once, then one line per cell."""
    labels: dict[str, dict[str, Any]] = {}
    for cell in plan.cells:
        settings = {key: value for key, value in cell.settings.items() if key != "task"}
        labels.setdefault(cell.label, {"overrides": cell.overrides, "identity": cell.identity, "settings": settings})
    head: dict[str, Any] = {
        "study": plan.name,
        "title": plan.title,
        "baseline": plan.baseline,
        "axis": plan.axis,
        "note": plan.note,
    }
    head["labels"] = labels
    cells = [
        {"id": c.id, "label": c.label, "task": c.task, "seeds": seeds_text(c.seeds), "repeat": c.repeat}
        for c in plan.cells
    ]
    lines = yaml.safe_dump({"cells": cells}, sort_keys=False, default_flow_style=None, width=1000)
    return yaml.safe_dump(head, sort_keys=False) + lines


def plan_from_text(text: str) -> StudyPlan:
    """The inverse of `plan_text`.

    Raises:
        yaml.YAMLError, KeyError, TypeError, ValueError: not a plan.
    """
    loaded = yaml.safe_load(text)
    cells = []
    for entry in loaded["cells"]:
        label = loaded["labels"][entry["label"]]
        cells.append(
            Cell(
                id=str(entry["id"]),
                label=entry["label"],
                overrides=label["overrides"],
                task=entry["task"],
                seeds=parse_seeds(entry["seeds"]),
                settings={**label["settings"], "task": [entry["task"]]},
                identity=label["identity"],
                repeat=entry["repeat"],
            )
        )
    return StudyPlan(
        loaded["study"], loaded["title"], loaded["baseline"], loaded["axis"], tuple(cells), loaded.get("note", "")
    )


def merge_plans(old: StudyPlan, new: StudyPlan) -> StudyPlan:
    """`new`, preceded by those cells of `old` that have its settings and seeds and a task that it does not name."""
    if (old.name, old.baseline) != (new.name, new.baseline):
        return new
    tasks = {cell.task for cell in new.cells}
    first = new.cells[0].task if new.cells else ""
    wanted = {_key(cell): cell for cell in new.cells if cell.task == first}
    kept = tuple(
        cell
        for cell in old.cells
        if cell.task not in tasks and _key(cell) in wanted and cell.id == _moved(wanted[_key(cell)], cell.task)
    )
    return replace(new, cells=kept + new.cells)


def _key(cell: Cell) -> tuple[str, tuple[int, ...], int]:
    return cell.label, cell.seeds, cell.repeat


def _moved(cell: Cell, task: str) -> str:
    """The id that a cell would have on another task."""
    return make_cell(cell.label, cell.overrides, cell.settings, cell.identity, task, cell.seeds, cell.repeat).id
