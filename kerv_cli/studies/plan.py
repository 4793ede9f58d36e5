"""From settings and tasks to cells and blocks; a cell's id is the hash of what determines its result."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kerv_cli.errors import UsageError
from kerv_cli.settings import RolloutSettings
from kerv_cli.studies.code import code_hash

Identity = Mapping[str, str]
"""Hashes of the weights and data behind a setting, e.g. {"target": sha256, "drafter": sha256}."""

OBSERVATION = "observation"
"""The identity's one entry that is no hash: what the target is shown. The target's hash implies it."""

# Of RolloutSettings, what leaves an episode's result as it is: where it is written, what is recorded of it, how it is
# called. Task and seeds enter the id as the cell's own, the policy through its hashes. A field that is not named here
# counts, so a setting that is added later makes new cells instead of being overlooked.
_NOT_DETERMINING = frozenset({"task", "episodes", "seed", "policy", "method", "results", "record", "record_size"})
_NOT_DETERMINING_RUNTIME = frozenset({"workers", "executor", "executor_options"})
_NOT_DETERMINING_POLICY = frozenset({"target", "drafter", "early"})


@dataclass(frozen=True)
class Cell:
    """One setting on one task and a block of seeds, once: the unit that is stored and reused.

    Two labels that resolve to the same result share one id.
    """

    id: str  # 16 hex digits, see `cell_id`
    label: str  # the setting's name in the study
    overrides: str  # what the user wrote to get it
    task: str
    seeds: tuple[int, ...]  # one episode each
    settings: dict[str, Any]  # plain RolloutSettings with task = [task]
    identity: dict[str, str] = field(default_factory=dict)  # hashes of target, drafter, ...
    repeat: int = 0  # the same episodes are measured `study.repeats` times


@dataclass(frozen=True)
class Block:
    """Cells of one task, the same seeds and one repeat: the unit that is run. All its settings take turns in one
    process, episode by episode, so that what is compared is measured side by side."""

    cells: tuple[Cell, ...]  # at least one; each id once

    @property
    def task(self) -> str:
        return self.cells[0].task

    @property
    def seeds(self) -> tuple[int, ...]:
        return self.cells[0].seeds

    @property
    def repeat(self) -> int:
        return self.cells[0].repeat

    @property
    def name(self) -> str:
        """For people, e.g. `reach-v3 100000-100004`."""
        return f"{self.task} {seeds_text(self.seeds)}" + (f" repeat {self.repeat}" if self.repeat else "")

    def order(self, seed: int) -> list[int]:
        """In which order its cells (indices) run the episode of `seed`: a permutation drawn from task, seed and
        repeat."""
        drawn = hashlib.sha256(f"{self.task} {seed} {self.repeat}".encode()).digest()
        return [int(i) for i in np.random.default_rng(list(drawn)).permutation(len(self.cells))]

    def without(self, names: Collection[str]) -> Block | None:
        """The block without the cells of those ids; None where nothing is left."""
        left = tuple(cell for cell in self.cells if cell.id not in names)
        return Block(left) if left else None


def cell_id(identity: Mapping[str, Any]) -> str:
    """First 16 hex digits of the SHA-256 of canonical JSON.

    Raises:
        ValueError: NaN or infinity, which JSON has not.
        TypeError: a value that is not plain.
    """
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()[:16]


def determinants(
    settings: Mapping[str, Any], identity: Identity, task: str, seeds: Sequence[int], repeat: int, code: str
) -> dict[str, Any]:
    """Everything that determines a cell's result, from plain RolloutSettings; the argument of `cell_id`. code: hash of
    the code that computes it."""
    kept = {key: value for key, value in settings.items() if key not in _NOT_DETERMINING}
    kept["runtime"] = _without(settings["runtime"], _NOT_DETERMINING_RUNTIME)
    policy = _without(settings["policy"], _NOT_DETERMINING_POLICY)
    return {
        "settings": kept,
        "policy": {**policy, **{f"{name}_sha256": value for name, value in identity.items() if name != OBSERVATION}},
        "task": task,
        "seeds": list(seeds),
        "repeat": repeat,
        "code": code,
    }


def _without(settings: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key not in set(names)}


def make_cell(
    label: str,
    overrides: str,
    settings: Mapping[str, Any],
    identity: Identity,
    task: str,
    seeds: Sequence[int],
    repeat: int = 0,
) -> Cell:
    """The cell of one setting (plain RolloutSettings) on one task and some seeds, for this code.

    Raises:
        ValueError: the device is still `auto`, which two machines resolve differently.
    """
    if settings["runtime"]["device"] == "auto":
        raise ValueError(f"setting '{label}': resolve runtime.device before planning")
    name = cell_id(determinants(settings, identity, task, seeds, repeat, code_hash()))
    return Cell(name, label, overrides, task, tuple(seeds), {**settings, "task": [task]}, dict(identity), repeat)


def plan(
    settings_by_label: Mapping[str, RolloutSettings],
    tasks: Sequence[str],
    identity: Identity | Callable[[RolloutSettings], Identity],
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
        identity: hashes of the weights, one mapping for all settings or a function where settings differ in them.
        baseline: label to put first.
        overrides: what the user wrote for each label, kept for the tables.
        block: seeds of a cell.
        repeats: how often everything is measured.

    Raises:
        ValueError: `baseline` is no label, or a device is `auto`.
        UsageError: `block` or `repeats` is less than 1.
    """
    if baseline is not None and baseline not in settings_by_label:
        raise ValueError(f"baseline '{baseline}' is not among the settings {list(settings_by_label)}")
    if min(block, repeats) < 1:
        raise UsageError(f"study.block={block} and study.repeats={repeats} must be at least 1")
    labels = sorted(settings_by_label, key=lambda label: label != baseline)
    hashes = {label: identity(s) if callable(identity) else identity for label, s in settings_by_label.items()}
    plain = {label: dataclasses.asdict(settings) for label, settings in settings_by_label.items()}
    written = overrides or {}
    return [
        make_cell(label, written.get(label, ""), plain[label], hashes[label], task, seeds, repeat)
        for repeat in range(repeats)
        for task in dict.fromkeys(tasks)
        for label in labels
        for seeds in _seed_blocks(settings_by_label[label], block)
    ]


def _seed_blocks(settings: RolloutSettings, size: int) -> Iterator[range]:
    end = settings.seed + settings.episodes
    return (range(first, min(first + size, end)) for first in range(settings.seed, end, size))


def blocks_of(cells: Iterable[Cell]) -> list[Block]:
    """The cells by task, seeds, repeat and threads (which belong to the process), in the order of their first cells;
    cells of one id once."""
    found: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in unique_cells(cells):
        key = cell.task, cell.seeds, cell.repeat, cell.settings["runtime"]["threads"]
        found.setdefault(key, []).append(cell)
    return [Block(tuple(group)) for group in found.values()]


def unique_cells(cells: Iterable[Cell]) -> list[Cell]:
    """The first cell of every id, in order: what has to be run."""
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
    for part in str(text).split(";"):
        first, _, last = part.partition("-")
        seeds.extend(range(int(first), int(last or first) + 1))
    return tuple(seeds)
