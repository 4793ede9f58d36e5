"""Splits a plan into the cells that a results folder holds and those to run, with the reason for each."""

from __future__ import annotations

import contextlib
import functools
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import write_folder
from kerv_cli.lab.claims import clean_void
from kerv_cli.lab.code import code_hash
from kerv_cli.lab.identity import ENGINE, OBSERVATION, depends_on_order, effective, flat, work_of
from kerv_cli.lab.plan import Cell, blocks_of, unique_cells
from kerv_cli.lab.store import ROLLOUTS, STUDIES, StudyStore, new_rollout, stores

NEVER, TIMED, CHANGED, ALL = "never", "timed", "changed", "all"
"""What `rerun=` runs again: nothing; settings whose times were not taken in turn; cells of other code; everything."""


@dataclass(frozen=True)
class StockEntry:
    """A complete cell on disk, unchecked: its hashes are compared when it is used. engine: version that computed it;
    code: hash of the source that computed it."""

    cell: Cell
    store: StudyStore
    started: str
    run: str
    engine: int
    code: str

    @property
    def work(self) -> tuple[str, str, int]:
        """Setting, task and repeat; equal to a planned cell's `work` where that cell means the same."""
        return work_of(self.cell.settings, self.cell.identity, self.engine), self.cell.task, self.cell.repeat


class Stock:
    """The complete cells of a study and, where there are such, of the other studies in its results folder."""

    def __init__(self, store: StudyStore, others: bool = True) -> None:
        self.store = store
        self.by_work: dict[tuple[str, str, int], list[StockEntry]] = {}
        self.by_label: dict[str, list[StockEntry]] = {}
        self.names: set[str] = set()  # of the study's own cells
        studies = stores(store.root.parent.parent) if others and store.family == STUDIES else []
        for one in [store, *(other for other in studies if other.name != store.name)]:
            for entry in _entries(one):
                self.by_work.setdefault(entry.work, []).append(entry)
                self.by_label.setdefault(entry.cell.label, []).append(entry)
                if one is store:
                    self.names.add(entry.cell.id)
        self.settings = {work[0] for work in self.by_work}
        self._blocks: dict[str, dict[int, str]] = {}

    def of(self, cell: Cell) -> list[StockEntry]:
        """Cells that hold results of the same work for some of its seeds."""
        entries = self.by_work.get(cell.work, [])
        if depends_on_order(cell.settings):
            return [entry for entry in entries if entry.cell.seeds == cell.seeds]
        return [entry for entry in entries if not set(entry.cell.seeds).isdisjoint(cell.seeds)]

    def block(self, entry: StockEntry, seed: int) -> str:
        """Name of the attempt at a block that measured the episode."""
        name = str(entry.store.cells / entry.cell.id)
        if name not in self._blocks:
            episodes = entry.store.read_cell(entry.cell.id).episodes
            self._blocks[name] = dict(zip(episodes["seed"], episodes["block"], strict=True))
        return self._blocks[name][seed]


def _entries(store: StudyStore) -> Iterator[StockEntry]:
    for folder in store.folders():
        try:
            config, status = store.described(folder.name)
            values = {key: config[key] for key in ("label", "task", "settings", "identity", "repeat")}
            cell = Cell(folder.name, overrides="", seeds=tuple(config["seeds"]), **values)
            engine, code = int(status["engine"]), str(status.get("code", ""))
            yield StockEntry(cell, store, str(status["started"]), str(status["run"]), engine, code)
        except (CheckpointError, KeyError, TypeError, ValueError, AttributeError):
            continue  # damaged: it is named where it is read


@dataclass
class Covered:
    """A plan for a store, whose cells are those on disk and those to run.

    reasons: id of a cell to run -> why. sources: id of a cell that another study holds -> that study.
    """

    store: StudyStore
    cells: list[Cell] = field(default_factory=list)
    reasons: dict[str, str] = field(default_factory=dict)
    sources: dict[str, StudyStore] = field(default_factory=dict)

    @property
    def complete(self) -> list[Cell]:
        """Its cells on disk."""
        return [cell for cell in self.cells if cell.id not in self.reasons]


Pieces = dict[int, StockEntry]
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
    splits: dict[int, tuple[Pieces, list[tuple[int, ...]]]] = {}

    def accepts(entry: StockEntry) -> bool:
        if rerun == ALL:
            return bool(since) and entry.started >= since
        return rerun != CHANGED or entry.code == code_hash()

    for group in groups.values():
        pieces = _pieces(group, stock, accepts)
        if rerun == TIMED:
            pieces = _in_turn(group, pieces, stock)
        for cell, piece, parts in zip(group, pieces, _parts(group, pieces), strict=True):
            splits[id(cell)] = piece, parts
    covered = Covered(stock.store)
    for cell in planned:
        _append(covered, cell, *splits[id(cell)], stock, rerun)
    return covered


def _pieces(group: Sequence[Cell], stock: Stock, accepts: Callable[[StockEntry], bool]) -> list[Pieces]:
    """The pieces of every cell. Of several entries with a seed, that of the run with most of the group's settings
    counts, because their times belong together; then one of this study; then the newest."""
    choices = [[entry for entry in stock.of(cell) if accepts(entry)] for cell in group]
    runs = Counter(run for entries in choices for run in {entry.run for entry in entries})
    return [
        {
            seed: entry
            for entry in sorted(entries, key=lambda e: (runs[e.run], e.store.name == stock.store.name, e.started))
            for seed in entry.cell.seeds
            if seed in cell.seeds
        }
        for cell, entries in zip(group, choices, strict=True)
    ]


def _in_turn(group: Sequence[Cell], pieces: Sequence[Pieces], stock: Stock) -> list[Pieces]:
    """The pieces without the seeds whose episodes the settings did not run in one block."""
    together = {
        seed
        for seed in group[0].seeds
        if all(seed in piece for piece in pieces) and len({stock.block(piece[seed], seed) for piece in pieces}) == 1
    }
    return [{seed: entry for seed, entry in piece.items() if seed in together} for piece in pieces]


def _parts(group: Sequence[Cell], pieces: Sequence[Pieces]) -> list[list[tuple[int, ...]]]:
    """Per cell the seeds to run, cut where another set of the group's settings runs them."""

    def misses(seed: int) -> tuple[int, ...]:
        return tuple(i for i, piece in enumerate(pieces) if seed not in piece)

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
            by_cell.setdefault(pieces[seed].cell.id, []).append(seed)
    for name, seeds in by_cell.items():
        covered.cells.append(cell.part(seeds, name))
        source = pieces[seeds[0]].store
        if source.name != stock.store.name:
            covered.sources[name] = source
    for seeds_to_run in parts:
        to_run = cell.part(seeds_to_run)
        if to_run.id in stock.names:
            to_run = to_run.again(stock.names)
        covered.cells.append(to_run)
        covered.reasons[to_run.id] = _reason(to_run, stock, rerun)


def _reason(cell: Cell, stock: Stock, rerun: str) -> str:
    """Why a cell is to run, in a few words."""
    seeds = {seed for entry in stock.of(cell) for seed in entry.cell.seeds}
    if seeds.issuperset(cell.seeds):
        return {TIMED: "times wanted in turn", CHANGED: "other code", ALL: "rerun=all"}.get(rerun, "order of episodes")
    if cell.work in stock.by_work:
        return "new seeds"
    if cell.work[0] in stock.settings:
        return "new task" if cell.repeat == 0 else "new repeat"
    target = cell.settings["policy"]["target"]
    near = [one for one in stock.by_label.get(cell.label, []) if one.cell.settings["policy"]["target"] == target]
    return _differences(near[-1], cell) if near else "new setting"


def _differences(entry: StockEntry, cell: Cell) -> str:
    """The changes from an entry's engine, weights and settings to a cell's of the same label, in a few words."""
    changes = [f"engine {entry.engine} → {ENGINE}"] if entry.engine != ENGINE else []
    weights = [
        kind
        for kind in dict.fromkeys([*cell.identity, *entry.cell.identity])
        if kind != OBSERVATION and cell.identity.get(kind) != entry.cell.identity.get(kind)
    ]
    names = {"target": f"weights of {cell.settings['policy']['target']}"}
    changes += [f"{names.get(kind, kind)} changed" for kind in weights]
    old, new = flat(effective(entry.cell.settings)), flat(effective(cell.settings))
    keys = [key for key in dict.fromkeys([*new, *old]) if old.get(key) != new.get(key)]
    changes += [f"{key} {old.get(key)} → {new.get(key)}" for key in keys]
    return ", ".join(changes[:3]) or "new setting"


def take_over(covered: Covered) -> None:
    """Copies the cells that other studies hold into the plan's. One that is damaged there is left out, so it runs here.

    Raises:
        StorageError: the disk refused.
    """
    for name, source in covered.sources.items():
        with contextlib.suppress(CheckpointError):
            source.status_of(name)
            copy = functools.partial(shutil.copytree, source.cells / name, dirs_exist_ok=True)
            write_folder(covered.store.cells / name, copy)


def cover_rollout(results: str, cells: Sequence[Cell]) -> Covered:
    """A rollout's cells in the newest run of the same cells that was interrupted, else in a new folder. A complete run
    is not reused, because who types a rollout wants it run."""
    work = {(*cell.work, cell.seeds) for cell in cells}
    for store in reversed(stores(Path(results).expanduser(), ROLLOUTS)):
        with contextlib.suppress(UsageError, CheckpointError):
            if {(*cell.work, cell.seeds) for cell in store.read_plan().cells} != work:
                continue
            clean_void(store.claims)
            covered = cover(cells, Stock(store, others=False))
            if covered.reasons:
                return covered
    return cover(cells, Stock(new_rollout(results, cells), others=False))


def disagreements(cells: Iterable[Cell], stock: Stock) -> list[str]:
    """A sentence for every cell that was measured twice with other results: other tokens of the same work."""
    sentences = []
    for cell in unique_cells(cells):
        for other in (e.cell.id for e in stock.of(cell) if e.store.name == stock.store.name and e.cell.id != cell.id):
            differ = _differ(stock.store, cell, other)
            if differ:
                sentences.append(
                    f"cells {other} and {cell.id} are the same work ({cell.label} on {cell.task}) and differ in "
                    f"{len(differ)} episodes, e.g. seed {differ[0]}: {cell.id} counts; code that changes tokens raises "
                    "ENGINE"
                )
    return sentences


def _differ(store: StudyStore, cell: Cell, other: str) -> list[int]:
    """Seeds of a cell whose episodes have other results in another one."""
    first, second = (store.read_cell(name).episodes.set_index("seed") for name in (cell.id, other))
    shared = [seed for seed in cell.seeds if seed in first.index and seed in second.index]
    columns = ["success", "steps", "forwards", "tokens"]
    return [s for s in shared if list(first.loc[s, columns]) != list(second.loc[s, columns])]


@dataclass(frozen=True)
class TimeEstimate:
    """Time for the cells of a plan that are not complete."""

    seconds: float  # wall time
    to_run: int  # cells
    reused: int
    source: str  # of the figure, in words


def estimate(covered: Covered, workers: int, prior_seconds: float) -> TimeEstimate:
    """Time for the cells that are to run, from the mean wall seconds per episode of the plan's other cells.

    A label with complete cells uses its own mean, others the mean over all; `prior_seconds` per episode is the guess
    where nothing is complete. Workers are taken to scale perfectly, up to one per block.

    Raises:
        CheckpointError: a complete cell cannot be read.
    """
    seconds: Counter[str] = Counter()
    episodes: Counter[str] = Counter()
    complete = unique_cells(covered.complete)
    to_run = unique_cells(cell for cell in covered.cells if cell.id in covered.reasons)
    for cell in complete:
        _, status = covered.sources.get(cell.id, covered.store).described(cell.id)
        seconds[cell.label] += status["wall_seconds"]
        episodes[cell.label] += status["episodes"]
    stored = episodes.total()
    prior = seconds.total() / stored if stored else prior_seconds
    means = {label: seconds[label] / count for label, count in episodes.items()}
    total = sum(len(cell.seeds) * means.get(cell.label, prior) for cell in to_run)
    source = f"measured on {stored} stored episodes" if stored else f"a guess of {prior_seconds:g} s per episode"
    at_once = max(1, min(workers, len(blocks_of(to_run, workers))))
    return TimeEstimate(total / at_once, len(to_run), len(complete), source)
