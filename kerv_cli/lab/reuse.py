"""What a results folder already holds of a plan, why the rest of it is to run, and where it is stored."""

from __future__ import annotations

import contextlib
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import write_folder
from kerv_cli.lab.code import code_hash
from kerv_cli.lab.identity import ENGINE, OBSERVATION, depends_on_order, effective, flat, work_of
from kerv_cli.lab.plan import Cell, unique_cells
from kerv_cli.lab.store import ROLLOUTS, StudyStore, stores, studies_of

_MOST_NAME = 32  # letters of the methods in a rollout's name

NEVER, TIMED, CHANGED, ALL = "never", "timed", "changed", "all"
"""What `rerun=` runs again: nothing; settings whose times were not taken in turn; cells of other code; everything."""


@dataclass(frozen=True)
class Kept:
    """A complete cell on disk, unchecked: its hashes are compared when it is used. engine: with which it was computed;
    code: hash of the source that computed it, empty before it was noted."""

    id: str
    store: StudyStore
    label: str
    task: str
    repeat: int
    seeds: tuple[int, ...]
    settings: Mapping[str, Any]
    identity: Mapping[str, str]
    started: str
    run: str
    engine: int
    code: str

    @property
    def work(self) -> tuple[str, str, int]:
        """As `Cell.work`."""
        return work_of(self.settings, self.identity, self.engine), self.task, self.repeat


class Stock:
    """The complete cells of a study and, where there are such, of the other studies in its results folder."""

    def __init__(self, store: StudyStore, others: bool = True) -> None:
        self.store = store
        self.by_work: dict[tuple[str, str, int], list[Kept]] = {}
        self.by_label: dict[str, list[Kept]] = {}
        self.names: set[str] = set()  # of the study's own cells
        for kept in _kept(store):
            self.names.add(kept.id)
            self._add(kept)
        for other in studies_of(store) if others else ():
            for kept in _kept(other):
                self._add(kept)
        self.settings = {work[0] for work in self.by_work}
        self._blocks: dict[str, dict[int, str]] = {}

    def _add(self, kept: Kept) -> None:
        self.by_work.setdefault(kept.work, []).append(kept)
        self.by_label.setdefault(kept.label, []).append(kept)

    def of(self, cell: Cell) -> list[Kept]:
        """Cells that hold results of the same work for some of its seeds."""
        kept = self.by_work.get(cell.work, [])
        if depends_on_order(cell.settings):
            return [one for one in kept if one.seeds == cell.seeds]
        return [one for one in kept if not set(one.seeds).isdisjoint(cell.seeds)]

    def block(self, kept: Kept, seed: int) -> str:
        """The attempt at a block in which the episode was measured; unknown in the oldest cells, then its run."""
        name = str(kept.store.cells / kept.id)
        if name not in self._blocks:
            episodes = kept.store.read_cell(kept.id).episodes
            self._blocks[name] = dict(zip(episodes["seed"], episodes["block"], strict=True))
        return self._blocks[name].get(seed) or kept.run


def _kept(store: StudyStore) -> Iterator[Kept]:
    for folder in store.folders():
        try:
            config, status = store.described(folder.name)
            yield Kept(
                folder.name,
                store,
                str(config["label"]),
                str(config["task"]),
                int(config["repeat"]),
                tuple(config["seeds"]),
                config["settings"],
                config["identity"],
                str(status.get("started", "")),
                str(status["run"]),
                int(status.get("engine", 1)),
                str(status.get("code", "")),
            )
        except (CheckpointError, KeyError, TypeError, ValueError, AttributeError):
            continue  # damaged: it is named where it is read


@dataclass
class Covered:
    """A plan whose cells are those on disk and those to run.

    reasons: id of a cell to run -> why. sources: id of a cell that another study holds -> that study.
    """

    cells: list[Cell] = field(default_factory=list)
    reasons: dict[str, str] = field(default_factory=dict)
    sources: dict[str, StudyStore] = field(default_factory=dict)


Pieces = dict[int, Kept]
"""Seed -> the cell on disk that holds its episode."""


def cover(planned: Sequence[Cell], stock: Stock, rerun: str = NEVER, since: str = "") -> Covered:
    """The planned cells, each as the cells on disk that hold its seeds and cells to run for the rest. Settings that
    miss the same seeds share blocks, so that they take turns.

    rerun: one of NEVER, TIMED, CHANGED, ALL. since: with ALL, cells that began at that time or later (ISO 8601) count:
    of the same command, interrupted.

    Raises:
        CheckpointError: rerun=timed, and a cell whose times it asks for is damaged.
    """
    groups: dict[tuple[str, tuple[int, ...], int], list[Cell]] = {}
    for cell in planned:
        groups.setdefault((cell.task, cell.seeds, cell.repeat), []).append(cell)
    whole: dict[int, tuple[Pieces, list[tuple[int, ...]]]] = {}
    accepts = _accepts(rerun, since)
    for group in groups.values():
        pieces = _pieces(group, stock, accepts)
        if rerun == TIMED:
            pieces = _in_turn(group, pieces, stock)
        whole |= {id(cell): (own, parts) for cell, own, parts in zip(group, pieces, _parts(group, pieces), strict=True)}
    covered = Covered()
    for cell in planned:
        _append(covered, cell, *whole[id(cell)], stock, rerun)
    return covered


def _accepts(rerun: str, since: str) -> Callable[[Kept], bool]:
    if rerun == CHANGED:
        code = code_hash()
        return lambda kept: kept.code == code
    if rerun == ALL:
        return lambda kept: bool(since) and kept.started >= since
    return lambda kept: True


def _pieces(group: Sequence[Cell], stock: Stock, accepts: Callable[[Kept], bool]) -> list[Pieces]:
    """Of every cell; first what the run measured that holds most of the group's settings, for their times belong
    together, then the study's own, then the newest."""
    choices = [[kept for kept in stock.of(cell) if accepts(kept)] for cell in group]
    runs = Counter(run for kept in choices for run in {one.run for one in kept})
    return [
        {
            seed: kept
            for kept in sorted(own, key=lambda k: (runs[k.run], k.store.name == stock.store.name, k.started))
            for seed in kept.seeds
            if seed in cell.seeds
        }
        for cell, own in zip(group, choices, strict=True)
    ]


def _in_turn(group: Sequence[Cell], pieces: Sequence[Pieces], stock: Stock) -> list[Pieces]:
    """Without the seeds whose episodes the settings did not run in one block."""
    together = {
        seed
        for seed in group[0].seeds
        if all(seed in own for own in pieces) and len({stock.block(own[seed], seed) for own in pieces}) == 1
    }
    return [{seed: kept for seed, kept in own.items() if seed in together} for own in pieces]


def _parts(group: Sequence[Cell], pieces: Sequence[Pieces]) -> list[list[tuple[int, ...]]]:
    """Per cell the seeds to run, cut where another set of the group's settings runs them."""

    def misses(seed: int) -> tuple[int, ...]:
        return tuple(i for i, own in enumerate(pieces) if seed not in own)

    cut = [(who, tuple(seeds)) for who, seeds in groupby(group[0].seeds, key=misses)]
    parts: list[list[tuple[int, ...]]] = []
    for i, cell in enumerate(group):
        if depends_on_order(cell.settings) and len(pieces[i]) < len(cell.seeds):
            pieces[i].clear()
            parts.append([cell.seeds])
        else:
            parts.append([seeds for who, seeds in cut if i in who])
    return parts


def _append(
    covered: Covered, cell: Cell, pieces: Pieces, parts: Sequence[tuple[int, ...]], stock: Stock, rerun: str
) -> None:
    by_cell: dict[str, list[int]] = {}
    for seed in cell.seeds:
        if seed in pieces:
            by_cell.setdefault(pieces[seed].id, []).append(seed)
    for name, stored in by_cell.items():
        covered.cells.append(cell.part(stored, name))
        source = pieces[stored[0]].store
        if source.name != stock.store.name:
            covered.sources[name] = source
    for missing in parts:
        to_run = cell.part(missing)
        if to_run.id in stock.names:
            to_run = to_run.again(stock.names)
        covered.cells.append(to_run)
        covered.reasons[to_run.id] = _reason(to_run, stock, rerun)


def _reason(cell: Cell, stock: Stock, rerun: str) -> str:
    """Why a cell is to run, in a few words."""
    stored = {seed for kept in stock.of(cell) for seed in kept.seeds}
    if stored.issuperset(cell.seeds):
        return {TIMED: "times wanted in turn", CHANGED: "other code", ALL: "rerun=all"}.get(rerun, "order of episodes")
    if cell.work in stock.by_work:
        return "new seeds"
    if cell.work[0] in stock.settings:
        return "new task" if cell.repeat == 0 else "new repeat"
    near = stock.by_label.get(cell.label, [])
    return _differences(near[-1], cell) if near else "new setting"


def _differences(kept: Kept, cell: Cell) -> str:
    """What of a stored setting has changed since, for a label that is still there."""
    told = [f"engine {kept.engine} → {ENGINE}"] if kept.engine != ENGINE else []
    weights = [
        kind
        for kind in dict.fromkeys([*cell.identity, *kept.identity])
        if kind != OBSERVATION and cell.identity.get(kind) != kept.identity.get(kind)
    ]
    told += [f"{_weights(kind, cell)} changed" for kind in weights]
    old, new = flat(effective(kept.settings)), flat(effective(cell.settings))
    keys = [key for key in dict.fromkeys([*new, *old]) if old.get(key) != new.get(key)]
    told += [f"{key} {old.get(key)} → {new.get(key)}" for key in keys]
    return ", ".join(told[:3]) or "new setting"


def _weights(kind: str, cell: Cell) -> str:
    if kind == "target":
        return f"weights of {cell.settings['policy']['target']}"
    return kind


def take_over(store: StudyStore, covered: Covered) -> None:
    """Copies the cells that other studies hold into `store`.

    Raises:
        StorageError: the disk refused.
    """
    for name, source in covered.sources.items():
        _copy(source, store, name)


def _copy(source: StudyStore, store: StudyStore, name: str) -> None:
    source.status_of(name)  # a damaged cell is not spread
    write_folder(
        store.cells / name, lambda temporary: shutil.copytree(source.cells / name, temporary, dirs_exist_ok=True)
    )


def begin(results: str, cells: Sequence[Cell]) -> tuple[StudyStore, list[Cell], int]:
    """Where the cells are stored, the cells under the names that they have there, and how many of them are complete:
    in a new folder, or in the newest run of the same cells that was interrupted. A run that is complete is not reused:
    a rollout is asked for in order to be run."""
    work = {(*cell.work, cell.seeds) for cell in cells}
    for store in reversed(stores(Path(results).expanduser(), ROLLOUTS)):
        with contextlib.suppress(UsageError, CheckpointError):
            if {(*cell.work, cell.seeds) for cell in store.read_plan().cells} != work:
                continue
            there = cover(cells, Stock(store, others=False))
            if there.reasons:
                return store, there.cells, len(there.cells) - len(there.reasons)
    return StudyStore(results, new_name(results, cells), ROLLOUTS), list(cells), 0


def new_name(results: str | Path, cells: Sequence[Cell]) -> str:
    """A free name: date, time and methods, e.g. `20260301-142530-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(cell.settings["method"]) for cell in unique_cells(cells)))
    name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:_MOST_NAME]}"
    taken = (Path(results).expanduser() / ROLLOUTS / name).exists()
    return f"{name}-{secrets.token_hex(2)}" if taken else name


def disagreements(cells: Iterable[Cell], stock: Stock) -> list[str]:
    """A sentence for every cell that was measured twice with other results: other tokens of the same work."""
    told = []
    for cell in {cell.id: cell for cell in cells}.values():
        kept = [one for one in stock.of(cell) if one.store.name == stock.store.name]
        for other in kept if len(kept) > 1 else ():
            if other.id == cell.id:
                continue
            differ = _differ(stock.store, cell, other)
            if differ:
                told.append(
                    f"cells {other.id} and {cell.id} are the same work ({cell.label} on {cell.task}) and differ in "
                    f"{len(differ)} episodes, e.g. seed {differ[0]}: {cell.id} counts; code that changes tokens raises "
                    "ENGINE"
                )
    return told


def _differ(store: StudyStore, cell: Cell, other: Kept) -> list[int]:
    first, second = (store.read_cell(name).episodes.set_index("seed") for name in (cell.id, other.id))
    shared = [seed for seed in cell.seeds if seed in first.index and seed in second.index]
    columns = ["success", "steps", "forwards", "tokens"]
    return [s for s in shared if list(first.loc[s, columns]) != list(second.loc[s, columns])]
