"""plan.yaml: a study's settings and cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from kerv_cli.files import read_yaml, to_yaml
from kerv_cli.manifests import read
from kerv_cli.parts import METHOD_KINDS
from kerv_cli.settings import RolloutSettings
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


@dataclass(frozen=True)
class _Label:
    overrides: str
    identity: dict[str, str]
    settings: dict[str, Any]


@dataclass(frozen=True)
class _Line:
    """A cell in the file. seeds: as `seeds_text`."""

    id: str
    label: str
    task: str
    seeds: str
    repeat: int


@dataclass(frozen=True)
class _File:
    """plan.yaml: every label's settings once, then one line per cell."""

    study: str
    title: str
    baseline: str
    axis: str
    labels: dict[str, _Label]
    cells: tuple[_Line, ...]
    note: str = ""


def plan_text(plan: StudyPlan) -> str:
    """The plan as YAML: every label's settings once, then one line per cell."""
    labels: dict[str, dict[str, Any]] = {}
    for cell in plan.cells:
        if cell.label not in labels:
            settings = {key: value for key, value in cell.settings.items() if key != "task"}
            labels[cell.label] = {"overrides": cell.overrides, "identity": cell.identity, "settings": settings}
    head: dict[str, Any] = {
        "study": plan.name,
        "title": plan.title,
        "baseline": plan.baseline,
        "axis": plan.axis,
        "note": plan.note,
        "labels": labels,
    }
    cells = [
        {"id": c.id, "label": c.label, "task": c.task, "seeds": seeds_text(c.seeds), "repeat": c.repeat}
        for c in plan.cells
    ]
    return to_yaml(head) + to_yaml({"cells": cells}, default_flow_style=None, width=1000)


def plan_from_text(text: str) -> StudyPlan:
    """The inverse of `plan_text`.

    Raises:
        CheckpointError, ValueError: not a plan, or one that contradicts itself.
    """
    found = read(_File, read_yaml(text), "the plan")
    for label in found.labels.values():
        read(RolloutSettings, label.settings, "the plan")
        wrong = [kind for kind in METHOD_KINDS if not isinstance(label.settings.get(kind, {}), dict)]
        if wrong or not label.settings.keys() & set(METHOD_KINDS):
            raise ValueError(f"a label has no settings of {' or '.join(wrong or METHOD_KINDS)}")
    unknown = {line.label for line in found.cells} - set(found.labels)
    if unknown or found.baseline not in found.labels:
        raise ValueError(f"it has no label {', '.join(sorted(unknown)) or found.baseline}")
    return StudyPlan(found.study, found.title, found.baseline, found.axis, tuple(_cells(found)), found.note)


def _cells(found: _File) -> Iterator[Cell]:
    shared: dict[tuple[str, str], dict[str, Any]] = {}  # of thousands of cells: memory
    for line in found.cells:
        label, key = found.labels[line.label], (line.label, line.task)
        if key not in shared:
            shared[key] = {**label.settings, "task": [line.task]}
        yield Cell(
            id=line.id,
            label=line.label,
            overrides=label.overrides,
            task=line.task,
            seeds=parse_seeds(line.seeds),
            settings=shared[key],
            identity=label.identity,
            repeat=line.repeat,
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
