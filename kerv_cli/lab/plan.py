"""A study's plan: cells and blocks, what is to run in which order, and plan.yaml. What a cell means is decided in
identity.py."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import read_yaml, to_yaml
from kerv_cli.base.manifests import read
from kerv_cli.base.settings import RolloutSettings
from kerv_cli.lab.identity import Identity, Plain, batch_of, hash_of, without, work_of

MOST_CELLS = 100_000
"""Cells of a study; more are refused before they are planned."""

MOST_SEEDS = 10_000
"""Seeds of a cell, at most `study.block` of them."""

FULL_BATCHES = 16
"""A block of a batch has so many times as many episodes as run at once: at its end places stay empty."""


@dataclass(frozen=True)
class Cell:
    """One setting on one task and a block of seeds, in one repeat: the unit that is stored and reused. Two labels with
    the same settings share one id."""

    id: str  # name of its folder: a hash of what it means, see identity.py
    label: str  # the setting's name in the study
    overrides: str  # of the configuration, as the user wrote them
    task: str
    seeds: tuple[int, ...]  # one episode each
    settings: dict[str, Any]  # plain RolloutSettings with task = [task]
    identity: dict[str, str] = field(default_factory=dict)  # hashes of target, drafter, ...
    repeat: int = 0  # the same episodes are measured `study.repeats` times

    @functools.cached_property
    def work(self) -> tuple[str, str, int]:
        """Setting (its hash), task and repeat: all that the cell means apart from its seeds."""
        return work_of(self.settings, self.identity), self.task, self.repeat

    def part(self, seeds: Sequence[int], name: str = "") -> Cell:
        """A cell of this work on these seeds. name: of its folder on disk; empty: the cell is to run."""
        return replace(self, seeds=tuple(seeds), id=name or hash_of([*self.work, list(seeds)]))

    def again(self, names: Collection[str]) -> Cell:
        """This cell with the first id that is not among the names: `<id>-2`, `<id>-3`, …"""
        return replace(self, id=next(n for n in (f"{self.id}-{i}" for i in range(2, 10_000)) if n not in names))


@dataclass(frozen=True)
class Block:
    """Cells of one task, the same seeds and one repeat: the unit that an executor runs. Its settings take turns in one
    process, episode by episode, so that compared episodes are measured one after the other.

    Cells of a batch are of one setting instead, of any tasks and seeds; `task` and `seeds` are those of the first.
    """

    cells: tuple[Cell, ...]  # at least one; each id once

    @property
    def task(self) -> str:
        """Full task name of its cells."""
        return self.cells[0].task

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of its episodes."""
        return self.cells[0].seeds

    @property
    def repeat(self) -> int:
        """Which of the study's repeats, from 0."""
        return self.cells[0].repeat

    @property
    def batch(self) -> int:
        """Episodes that run at the same time."""
        return batch_of(self.cells[0].settings)

    @property
    def title(self) -> str:
        """Name and size of the block, for a display."""
        if self.batch == 1:
            return f"{self.name}: {len(self.cells)} settings in turn"
        return f"{self.cells[0].label} from {self.name} on: {_episodes(self.cells)} episodes, {self.batch} at a time"

    @property
    def name(self) -> str:
        """Task, seeds and repeat, e.g. `reach-v3 100000-100004`."""
        return f"{self.task} {seeds_text(self.seeds)}" + (f" repeat {self.repeat}" if self.repeat else "")

    def order(self, seed: int) -> list[int]:
        """Indices of its cells in the order in which they run the episode of `seed`: a permutation drawn from task,
        seed and repeat."""
        digest = hashlib.sha256(f"{self.task} {seed} {self.repeat}".encode()).digest()
        return [int(i) for i in np.random.default_rng(list(digest)).permutation(len(self.cells))]

    def without(self, names: Collection[str]) -> Block | None:
        """The block without the cells of those ids; None if no cell is left."""
        cells = tuple(cell for cell in self.cells if cell.id not in names)
        return Block(cells) if cells else None


def make_cell(
    label: str, overrides: str, settings: Plain, identity: Identity, task: str, seeds: Sequence[int], repeat: int = 0
) -> Cell:
    """The cell of one setting (plain RolloutSettings) on one task and some seeds.

    Raises:
        ValueError: the device is still `auto`, which two machines resolve differently.
    """
    if settings["runtime"]["device"] == "auto":
        raise ValueError(f"setting '{label}': resolve runtime.device before planning")
    cell = Cell("", label, overrides, task, tuple(seeds), {**settings, "task": [task]}, dict(identity), repeat)
    return cell.part(seeds)


def plan(
    settings_by_label: Mapping[str, RolloutSettings],
    tasks: Sequence[str],
    identity: Identity | Callable[[str], Identity],
    *,
    baseline: str | None = None,
    overrides: Mapping[str, str] | None = None,
    block: int = 5,
    repeats: int = 1,
) -> list[Cell]:
    """The cells of every label, task and block of seeds: repeat by repeat, task by task, the baseline first.

    Args:
        settings_by_label: resolved settings; their order is kept.
        tasks: full task names, suites already expanded.
        identity: hashes of the weights, one mapping for all settings or those of a label.
        baseline: label to put first.
        overrides: what the user wrote for each label, kept for the tables.
        block: seeds of a cell.
        repeats: how often everything is measured.

    Raises:
        ValueError: a device is `auto`.
        UsageError: more than MOST_CELLS cells.
    """
    blocks = sum(-(-settings.episodes // block) for settings in settings_by_label.values())
    tasks = list(dict.fromkeys(tasks))
    if blocks * len(tasks) * repeats > MOST_CELLS:
        raise UsageError(f"the study has {blocks * len(tasks) * repeats} cells: at most {MOST_CELLS}, plan fewer")
    labels = sorted(settings_by_label, key=lambda label: label != baseline)
    hashes = {label: identity(label) if callable(identity) else identity for label in labels}
    plain = {label: asdict(settings) for label, settings in settings_by_label.items()}
    seeds = {label: range(s.seed, s.seed + s.episodes) for label, s in settings_by_label.items()}
    words = overrides or {}
    return [
        make_cell(label, words.get(label, ""), plain[label], hashes[label], task, seeds[label][at : at + block], repeat)
        for repeat in range(repeats)
        for task in tasks
        for label in labels
        for at in range(0, len(seeds[label]), block)
    ]


def blocks_of(cells: Iterable[Cell], workers: int = 1) -> list[Block]:
    """The cells grouped by task, seeds, repeat and threads (a process has one number of them), in the order of their
    first cells; each id once. Those of a batch are grouped by setting, into as many blocks as there are workers or
    more."""
    groups: dict[tuple[object, ...], list[Cell]] = {}
    for cell in unique_cells(cells):
        key: tuple[object, ...] = cell.task, cell.seeds, cell.repeat, cell.settings["runtime"]["threads"]
        if batch_of(cell.settings) > 1:
            key = (json.dumps([without(cell.settings, {"task"}), cell.identity], sort_keys=True), cell.repeat)
        groups.setdefault(key, []).append(cell)
    return [Block(tuple(part)) for group in groups.values() for part in _parts(group, workers)]


def _parts(group: Sequence[Cell], workers: int) -> Iterator[list[Cell]]:
    """The cells of one block; those of a batch in parts of as many episodes as keep every worker's batch full."""
    batch = batch_of(group[0].settings)
    if batch == 1:
        yield list(group)
        return
    most = min(FULL_BATCHES * batch, -(-_episodes(group) // workers))
    part: list[Cell] = []
    for cell in group:
        if part and _episodes(part) + len(cell.seeds) > most:
            yield part
            part = []
        part.append(cell)
    yield part


def _episodes(cells: Iterable[Cell]) -> int:
    return sum(len(cell.seeds) for cell in cells)


def unique_cells(cells: Iterable[Cell]) -> list[Cell]:
    """The first cell of every id, in order."""
    first: dict[str, Cell] = {}
    for cell in cells:
        first.setdefault(cell.id, cell)
    return list(first.values())


def seeds_text(seeds: Iterable[int]) -> str:
    """Seeds as ranges: (5, 6, 7, 9) -> "5-7;9"."""
    runs: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return ";".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def parse_seeds(text: str) -> tuple[int, ...]:
    """The inverse of `seeds_text`.

    Raises:
        ValueError: not a list of ranges.
    """
    seeds: list[int] = []
    for part in text.split(";"):
        first, _, last = part.partition("-")
        span = range(int(first), int(last or first) + 1)
        if not 0 < len(span) <= MOST_SEEDS:
            raise ValueError(f"'{part}' is no range of seeds")
        seeds.extend(span)
    return tuple(seeds)


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
    settings: dict[str, Any]  # without the task


@dataclass(frozen=True)
class _Line:
    """A cell in the file. seeds: as `seeds_text`."""

    id: str
    label: str
    task: str
    seeds: str
    repeat: int


@dataclass(frozen=True, kw_only=True)
class _File:
    """plan.yaml: every label's settings once, then one line per cell."""

    study: str
    title: str
    baseline: str
    axis: str
    note: str = ""
    labels: dict[str, _Label]
    cells: tuple[_Line, ...]


def plan_text(plan: StudyPlan) -> str:
    """The plan as YAML."""
    labels = {c.label: _Label(c.overrides, c.identity, without(c.settings, {"task"})) for c in reversed(plan.cells)}
    labels = {label: labels[label] for label in plan.labels}
    lines = tuple(_Line(c.id, c.label, c.task, seeds_text(c.seeds), c.repeat) for c in plan.cells)
    head = {name: getattr(plan, name) for name in ("title", "baseline", "axis", "note")}
    file = asdict(_File(study=plan.name, labels=labels, cells=lines, **head))
    cells = list(file.pop("cells"))
    return to_yaml(file) + to_yaml({"cells": cells}, default_flow_style=None, width=1000)


def plan_from_text(text: str) -> StudyPlan:
    """The inverse of `plan_text`.

    Raises:
        CheckpointError, ValueError: not a plan, or one that contradicts itself.
    """
    file = read(_File, read_yaml(text), "the plan")
    unknown = {line.label for line in file.cells} - set(file.labels)
    if unknown or file.baseline not in file.labels:
        raise ValueError(f"it has no label {', '.join(sorted(unknown)) or file.baseline}")
    return StudyPlan(file.study, file.title, file.baseline, file.axis, tuple(_cells_of(file)), file.note)


def _cells_of(file: _File) -> Iterator[Cell]:
    shared: dict[tuple[str, str], dict[str, Any]] = {}  # of thousands of cells: memory
    for line in file.cells:
        label, key = file.labels[line.label], (line.label, line.task)
        if key not in shared:
            shared[key] = {**label.settings, "task": [line.task]}
        seeds = parse_seeds(line.seeds)
        yield Cell(line.id, line.label, label.overrides, line.task, seeds, shared[key], label.identity, line.repeat)


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
