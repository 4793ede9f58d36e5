"""Cells and blocks of a study; a cell's id is the hash of everything that determines its result."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kerv_cli.errors import UsageError
from kerv_cli.settings import MODEL, RolloutSettings
from kerv_cli.studies.code import code_hash

Identity = Mapping[str, str]
"""Hashes of the weights and data behind a setting, e.g. {"target": sha256, "drafter": sha256}."""

MOST_CELLS = 100_000
"""Cells of a study; more are refused before they are planned."""

MOST_SEEDS = 10_000
"""Seeds of a cell, at most `study.block` of them."""

FULL_BATCHES = 16
"""A block of a batch has so many times as many episodes as run at once: at its end places stay empty."""

OBSERVATION = "observation"
"""Key of the identity's only entry that is not a hash: what the target observes. The target's hash determines it."""

# Fields of RolloutSettings that do not change an episode's result (where it is written, how much of it is recorded,
# names), or that enter the id otherwise (task and seeds as the cell's own, the policy by its hashes). All other fields
# count, so that a new setting makes new cells instead of being overlooked.
NOT_DETERMINING = frozenset({"task", "episodes", "seed", "policy", "method", "results", "record", "record_size"})
NOT_DETERMINING_RUNTIME = frozenset({"workers", "executor", "executor_options"})


@dataclass(frozen=True)
class Cell:
    """One setting on one task and a block of seeds, in one repeat: the unit that is stored and reused. Two labels with
    the same settings share one id."""

    id: str  # 16 hex digits, see `cell_id`
    label: str  # the setting's name in the study
    overrides: str  # of the configuration, as the user wrote them
    task: str
    seeds: tuple[int, ...]  # one episode each
    settings: dict[str, Any]  # plain RolloutSettings with task = [task]
    identity: dict[str, str] = field(default_factory=dict)  # hashes of target, drafter, ...
    repeat: int = 0  # the same episodes are measured `study.repeats` times


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
        """What it is, in a few words."""
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
        drawn = hashlib.sha256(f"{self.task} {seed} {self.repeat}".encode()).digest()
        return [int(i) for i in np.random.default_rng(list(drawn)).permutation(len(self.cells))]

    def without(self, names: Collection[str]) -> Block | None:
        """The block without the cells of those ids; None if no cell is left."""
        left = tuple(cell for cell in self.cells if cell.id not in names)
        return Block(left) if left else None


def cell_id(identity: Mapping[str, Any]) -> str:
    """First 16 hex digits of the SHA-256 of canonical JSON.

    Raises:
        ValueError: NaN or infinity, which JSON lacks.
        TypeError: a value that is not JSON's.
    """
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()[:16]


def determinants(
    settings: Mapping[str, Any], identity: Identity, task: str, seeds: Sequence[int], repeat: int, code: str
) -> dict[str, Any]:
    """Everything that determines a cell's result, from plain RolloutSettings; the argument of `cell_id`. code: as
    `code_hash`."""
    kept = without(settings, NOT_DETERMINING)
    kept["runtime"] = without(settings["runtime"], NOT_DETERMINING_RUNTIME)
    if not stress_of(settings)["level"]:
        kept["world"] = without(settings["world"], {"stress"})  # level 0 of every kind is the same world
    hashes = {f"{name}_sha256": value for name, value in identity.items() if name != OBSERVATION}
    return {
        "settings": kept,
        "policy": {"kind": settings["policy"].get("kind", MODEL), **hashes},
        "task": task,
        "seeds": list(seeds),
        "repeat": repeat,
        "code": code,
    }


def is_result_of(config: Mapping[str, Any], cell: Cell) -> bool:
    """Whether a stored cell's config.yaml holds what determines the result of `cell`."""
    try:
        own = config["settings"], config["identity"], config["task"], config["seeds"], config["repeat"], ""
        wanted = cell.settings, cell.identity, cell.task, list(cell.seeds), cell.repeat, ""
        return determinants(*own) == determinants(*wanted)
    except (KeyError, TypeError, AttributeError):
        return False


def stress_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Kind and level of the stress in plain RolloutSettings; `none` where nothing is shifted."""
    stress = settings["world"].get("stress", {})
    level = int(stress.get("level", 0))
    return {"kind": stress["kind"] if level else "none", "level": level}


def batch_of(settings: Mapping[str, Any]) -> int:
    """Episodes that run at the same time in plain RolloutSettings; with more than one they have no times."""
    return int(settings.get("rollout", {}).get("batch", 1))


def without(settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """The settings without those keys."""
    return {key: value for key, value in settings.items() if key not in names}


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
        UsageError: more than MOST_CELLS cells.
    """
    if baseline is not None and baseline not in settings_by_label:
        raise ValueError(f"baseline '{baseline}' is not among the settings {list(settings_by_label)}")
    blocks = sum(-(-settings.episodes // block) for settings in settings_by_label.values())
    tasks = list(dict.fromkeys(tasks))
    if blocks * len(tasks) * repeats > MOST_CELLS:
        raise UsageError(f"the study has {blocks * len(tasks) * repeats} cells: at most {MOST_CELLS}, plan fewer")
    labels = sorted(settings_by_label, key=lambda label: label != baseline)
    hashes = {label: identity(s) if callable(identity) else identity for label, s in settings_by_label.items()}
    plain = {label: dataclasses.asdict(settings) for label, settings in settings_by_label.items()}
    written = overrides or {}
    return [
        make_cell(label, written.get(label, ""), plain[label], hashes[label], task, seeds, repeat)
        for repeat in range(repeats)
        for task in tasks
        for label in labels
        for seeds in _seed_blocks(settings_by_label[label], block)
    ]


def _seed_blocks(settings: RolloutSettings, size: int) -> Iterator[range]:
    end = settings.seed + settings.episodes
    return (range(first, min(first + size, end)) for first in range(settings.seed, end, size))


def blocks_of(cells: Iterable[Cell], workers: int = 1) -> list[Block]:
    """The cells grouped by task, seeds, repeat and threads (a process has one number of them), in the order of their
    first cells; each id once. Those of a batch are grouped by setting, into as many blocks as there are workers or
    more."""
    found: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in unique_cells(cells):
        key: tuple[Any, ...] = cell.task, cell.seeds, cell.repeat, cell.settings["runtime"]["threads"]
        if batch_of(cell.settings) > 1:
            key = (json.dumps([without(cell.settings, {"task"}), cell.identity], sort_keys=True), cell.repeat)
        found.setdefault(key, []).append(cell)
    return [Block(tuple(part)) for group in found.values() for part in _parts(group, workers)]


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
        drawn = range(int(first), int(last or first) + 1)
        if not 0 < len(drawn) <= MOST_SEEDS:
            raise ValueError(f"'{part}' is no range of seeds")
        seeds.extend(drawn)
    return tuple(seeds)
