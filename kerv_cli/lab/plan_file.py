"""plan.yaml: a study's settings and cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from kerv_cli.base.files import read_yaml, to_yaml
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import METHOD_KINDS
from kerv_cli.base.settings import RolloutSettings
from kerv_cli.lab.identity import complete_settings
from kerv_cli.lab.plan import Cell, parse_seeds, seeds_text


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
    file = read(_File, read_yaml(text), "the plan", tolerant=True)
    for label in file.labels.values():
        read(RolloutSettings, label.settings, "the plan", tolerant=True)
        wrong = [kind for kind in METHOD_KINDS if not isinstance(label.settings.get(kind, {}), dict)]
        if wrong or not label.settings.keys() & set(METHOD_KINDS):
            raise ValueError(f"a label has no settings of {' or '.join(wrong or METHOD_KINDS)}")
    unknown = {line.label for line in file.cells} - set(file.labels)
    if unknown or file.baseline not in file.labels:
        raise ValueError(f"it has no label {', '.join(sorted(unknown)) or file.baseline}")
    return StudyPlan(file.study, file.title, file.baseline, file.axis, tuple(_cells(file)), file.note)


def _cells(file: _File) -> Iterator[Cell]:
    complete: dict[str, dict[str, Any]] = {}
    shared: dict[tuple[str, str], dict[str, Any]] = {}  # of thousands of cells: memory
    for line in file.cells:
        label, key = file.labels[line.label], (line.label, line.task)
        if line.label not in complete:
            complete[line.label] = complete_settings(label.settings)
        if key not in shared:
            shared[key] = {**complete[line.label], "task": [line.task]}
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
    """`new`, preceded by the cells of `old` with its settings and seeds on tasks that `new` does not name."""
    if (old.name, old.baseline) != (new.name, new.baseline):
        return new
    tasks = {cell.task for cell in new.cells}
    settings = {(cell.label, cell.repeat): cell.work[0] for cell in new.cells}
    seeds: dict[tuple[str, int], set[int]] = {}
    for cell in new.cells:
        seeds.setdefault((cell.label, cell.repeat), set()).update(cell.seeds)
    cells = []
    for cell in old.cells:
        key = cell.label, cell.repeat
        shared = [seed for seed in cell.seeds if seed in seeds.get(key, ())]
        if shared and cell.task not in tasks and cell.work[0] == settings[key]:
            cells.append(cell.part(shared, cell.id))
    return replace(new, cells=(*cells, *new.cells))
