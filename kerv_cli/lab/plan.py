"""What a study wants, what the database has of it, and what is left to run, with the reason."""

from __future__ import annotations

import functools
import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.episodes.identity import (
    ENGINE,
    OBSERVATION,
    Identity,
    Plain,
    batch_of,
    depends_on_order,
    effective,
    flat,
    without,
    work_of,
)

MOST_EPISODES = 1_000_000
"""Episodes of a study; more are refused before they are planned."""
FULL_BATCHES = 16
"""A block of a batch has at most this many times as many episodes as run at once."""

NEVER, TIMED, CHANGED, ALL = "never", "timed", "changed", "all"
"""What `rerun=` runs again: nothing; what was not timed in turn; what other code computed; everything."""


@dataclass(frozen=True, eq=False)
class Setting:
    """One row of a study's table.

    Attributes:
        label: Its name in the study.
        overrides: The overrides that make it, as the user wrote them.
        settings: Plain RolloutSettings, without the task.
        identity: Hashes of the weights and data that it reads.
        varies: Key -> value of those overrides in which the settings of a grid differ.
        name: What the settings of a grid share; by default the label.
    """

    label: str
    overrides: str
    settings: Plain
    identity: Identity
    varies: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.label)

    @functools.cached_property
    def work(self) -> str:
        """Hash of everything that determines a result, apart from task, seed and repeat."""
        return work_of(self.settings, self.identity)

    def on(self, task: str) -> dict[str, Any]:
        """Return plain RolloutSettings for one task."""
        return {**self.settings, "task": [task]}


@dataclass(frozen=True)
class Wanted:
    """One episode that a study wants."""

    setting: Setting
    task: str
    seed: int
    repeat: int = 0

    @property
    def key(self) -> tuple[str, str, int, int]:
        """What the episode means: equal keys are the same episode in any study."""
        return self.setting.work, self.task, self.seed, self.repeat


@dataclass(frozen=True)
class Study:
    """A study and the episodes that it wants, in the order in which they run.

    Attributes:
        name: Its name in the database.
        kind: sweep, rollout or import.
        baseline: Label of the setting that the others are compared with.
        axis: Config key of the plots' x axis; empty: none.
        note: A sentence that says what to see.
        block: Seeds for which the settings take turns in one process.
    """

    name: str
    settings: tuple[Setting, ...]
    wanted: tuple[Wanted, ...]
    kind: str = "sweep"
    title: str = ""
    baseline: str = ""
    axis: str = ""
    note: str = ""
    block: int = 5

    @property
    def labels(self) -> list[str]:
        """Labels of the settings, in order."""
        return [setting.label for setting in self.settings]

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks, in order."""
        return list(dict.fromkeys(one.task for one in self.wanted))

    def setting(self, label: str) -> Setting:
        """Return the setting of a label."""
        return next(setting for setting in self.settings if setting.label == label)


def wanted_of(
    settings: Sequence[Setting], tasks: Iterable[str], block: int = 5, repeats: int = 1
) -> tuple[Wanted, ...]:
    """Return every episode of these settings: repeat by repeat, task by task, block of seeds by block of seeds.

    Raises:
        UsageError: More than MOST_EPISODES.
    """
    tasks = list(dict.fromkeys(tasks))
    count = len(tasks) * repeats * sum(setting.settings["episodes"] for setting in settings)
    if count > MOST_EPISODES:
        raise UsageError(f"the study has {count} episodes: at most {MOST_EPISODES}, plan fewer")
    seeds = {s.label: range(s.settings["seed"], s.settings["seed"] + s.settings["episodes"]) for s in settings}
    longest = max((len(one) for one in seeds.values()), default=0)
    return tuple(
        Wanted(setting, task, seed, repeat)
        for repeat in range(repeats)
        for task in tasks
        for first in range(0, longest, block)
        for setting in settings
        for seed in seeds[setting.label][first : first + block]
    )


@dataclass(frozen=True)
class Measured:
    """An episode in the database, by what decides whether a study can use it."""

    id: int
    block: str
    started: str  # of its block
    code: str
    seeds: str  # of its block


@dataclass(frozen=True)
class Block:
    """Episodes that one process runs: of one task and one repeat, whose settings take turns seed by seed.

    A block of a batch has one setting instead, and any tasks and seeds.
    """

    wanted: tuple[Wanted, ...]  # at least one

    @property
    def task(self) -> str:
        """Task of its first episode."""
        return self.wanted[0].task

    @functools.cached_property
    def settings(self) -> tuple[Setting, ...]:
        """Its settings, each once."""
        return tuple({one.setting.work: one.setting for one in self.wanted}.values())

    @property
    def seeds(self) -> list[int]:
        """Its seeds, each once, ascending."""
        return sorted({one.seed for one in self.wanted})

    @property
    def batch(self) -> int:
        """Episodes that run at the same time."""
        return batch_of(self.wanted[0].setting.settings)

    @property
    def name(self) -> str:
        """Task and seeds, e.g. `reach-v3 100000-100004`."""
        repeat = self.wanted[0].repeat
        return f"{self.task} {seeds_text(self.seeds)}" + (f" repeat {repeat}" if repeat else "")

    @property
    def title(self) -> str:
        """Name and size, for a display."""
        if self.batch == 1:
            return f"{self.name}: {count(len(self.settings), 'setting')} in turn"
        label = self.wanted[0].setting.label
        return f"{label} from {self.name} on: {count(len(self.wanted), 'episode')}, {self.batch} at a time"

    def turns(self) -> Iterator[Wanted]:
        """Yield its episodes seed by seed; the order of the settings is drawn from task, seed and repeat."""
        for seed in self.seeds:
            turn = [one for one in self.wanted if one.seed == seed]
            digest = hashlib.sha256(f"{self.task} {seed} {turn[0].repeat}".encode()).digest()
            for index in np.random.default_rng(list(digest)).permutation(len(turn)):
                yield turn[int(index)]


@dataclass
class Split:
    """A study, split into the episodes that the database has and those to run.

    Attributes:
        study: What is wanted.
        there: Wanted episode -> its row.
        reasons: Wanted episode to run -> why, in a few words.
        newest: Id of the newest row that was looked at. Later ones are of sweeps that run at the same time.
    """

    study: Study
    there: dict[Wanted, Measured] = field(default_factory=dict)
    reasons: dict[Wanted, str] = field(default_factory=dict)
    newest: int = 0

    @property
    def to_run(self) -> list[Wanted]:
        """The episodes to run; one that two labels share runs once."""
        return list({one.key: one for one in self.reasons}.values())

    def blocks(self, workers: int = 1) -> list[Block]:
        """Return the episodes to run as blocks, in the order of their first episodes."""
        return blocks_of(self.to_run, self.study.block, workers)


def split(
    study: Study, stock: Mapping[tuple[str, str, int, int], Sequence[Measured]], rerun: str = NEVER, since: str = ""
) -> Split:
    """Return the plan of a study: wanted episodes minus those of the database.

    Args:
        study: What is wanted.
        stock: Meaning of an episode -> its rows in the database.
        rerun: One of NEVER, TIMED, CHANGED, ALL.
        since: With ALL, rows of blocks that began then or later count (ISO 8601): of the same command, interrupted.
    """
    from kerv_cli.episodes.code import code_hash

    def accepted(row: Measured) -> bool:
        if rerun == ALL:
            return bool(since) and row.started >= since
        return rerun != CHANGED or row.code == code_hash()

    plan = Split(study, newest=max((row.id for rows in stock.values() for row in rows), default=0))
    known = {work: True for work, *_ in stock}
    tasks = {(work, task) for work, task, *_ in stock}
    usable = {one: [row for row in stock.get(one.key, ()) if accepted(row)] for one in study.wanted}
    _only_whole_orders(usable, study.block)
    for turn in _turns(study.wanted).values():
        rows = {one: usable[one] for one in turn}
        of_block = Counter(row.block for found in rows.values() for row in found)
        chosen = {one: max(found, key=lambda row: (of_block[row.block], row.started, row.id), default=None)
                  for one, found in rows.items()}  # fmt: skip
        if rerun == TIMED and len({row and row.block for row in chosen.values()}) > 1:
            chosen = dict.fromkeys(chosen)
        for one, row in chosen.items():
            if row is not None:
                plan.there[one] = row
            else:
                plan.reasons[one] = _reason(one, stock, known, tasks, rerun)
    _whole_orders(plan)
    return plan


def _turns(wanted: Iterable[Wanted]) -> dict[tuple[str, int, int], list[Wanted]]:
    """(task, seed, repeat) -> its episodes, which take turns."""
    turns: dict[tuple[str, int, int], list[Wanted]] = {}
    for one in wanted:
        turns.setdefault((one.task, one.seed, one.repeat), []).append(one)
    return turns


def _only_whole_orders(usable: dict[Wanted, list[Measured]], block: int) -> None:
    """Leave episodes that depend on those before them the rows of one block that ran all their seeds, or none."""
    sizes = Counter(row.block for rows in usable.values() for row in rows)
    for seeds in _ordered_chunks(usable, block):
        text = seeds_text(one.seed for one in seeds)
        whole = [row for row in usable[seeds[0]] if row.seeds == text]
        whole = [row for row in whole if all(any(row.block == other.block for other in usable[one]) for one in seeds)]
        best = max(whole, key=lambda row: (sizes[row.block], row.started, row.id), default=None)
        for one in seeds:
            usable[one] = [row for row in usable[one] if best is not None and row.block == best.block]


def _whole_orders(plan: Split) -> None:
    """Run a block of seeds whole if an episode's result depends on the episodes before it."""
    for seeds in _ordered_chunks(plan.study.wanted, plan.study.block):
        if any(one in plan.reasons for one in seeds):
            for one in seeds:
                plan.there.pop(one, None)
                plan.reasons.setdefault(one, "order of episodes")


def _ordered_chunks(wanted: Iterable[Wanted], block: int) -> Iterator[list[Wanted]]:
    """Yield the episodes of each setting, task and repeat that depend on their order, by blocks of seeds."""

    def key(one: Wanted) -> tuple[str, str, int, int]:
        return one.setting.work, one.task, one.repeat, (one.seed - one.setting.settings["seed"]) // block

    groups: dict[tuple[str, str, int, int], list[Wanted]] = {}
    ordered: dict[str, bool] = {}
    for one in wanted:
        work = one.setting.work
        if work not in ordered:
            ordered[work] = depends_on_order(one.setting.settings)
        if ordered[work]:
            groups.setdefault(key(one), []).append(one)
    yield from groups.values()


def blocks_of(wanted: Iterable[Wanted], block: int, workers: int = 1) -> list[Block]:
    """Return episodes grouped into blocks.

    Seeds stay together that the study runs together and that the same settings miss, or all of them if a setting
    depends on the order of episodes. A process has one number of threads. Episodes of a batch are grouped by setting,
    into at least as many blocks as there are workers.
    """
    batches: dict[tuple[str, int], list[Wanted]] = {}
    in_turn: list[Wanted] = []
    for one in wanted:
        if batch_of(one.setting.settings) > 1:
            batches.setdefault((one.setting.work, one.repeat), []).append(one)
        else:
            in_turn.append(one)
    groups: dict[tuple[object, ...], list[Wanted]] = {}
    for (task, seed, repeat), turn in _turns(in_turn).items():
        for threads, some in groupby(sorted(turn, key=_threads), key=_threads):
            part = list(some)
            first = min(one.setting.settings["seed"] for one in part)
            missing = sorted(one.setting.work for one in part)
            ordered = sorted(one.setting.work for one in part if depends_on_order(one.setting.settings))
            groups.setdefault((task, repeat, threads, (seed - first) // block, *(ordered or missing)), []).extend(part)
    blocks = [Block(tuple(group)) for group in groups.values()]
    for group in batches.values():
        size = min(FULL_BATCHES * batch_of(group[0].setting.settings), -(-len(group) // workers))
        blocks += [Block(tuple(group[at : at + size])) for at in range(0, len(group), size)]
    return blocks


def _threads(one: Wanted) -> int:
    return int(one.setting.settings["runtime"]["threads"])


def _reason(
    one: Wanted,
    stock: Mapping[Any, Sequence[Measured]],
    known: Mapping[str, bool],
    tasks: set[tuple[str, str]],
    rerun: str,
) -> str:
    """Return why an episode is to run, in a few words."""
    if stock.get(one.key):
        return {TIMED: "times wanted in turn", CHANGED: "other code", ALL: "rerun=all"}.get(rerun, "order of episodes")
    if (one.setting.work, one.task) in tasks:
        return "new repeat" if one.repeat else "new seeds"
    return "new task" if one.setting.work in known else NEW_SETTING


NEW_SETTING = "new setting"


def differences(old: Setting, work: str, new: Setting) -> str:
    """Return what changed from a stored setting with this `work` to the one of the same label, in a few words."""
    engine = next((one for one in range(ENGINE, 0, -1) if work_of(old.settings, old.identity, one) == work), ENGINE)
    changes = [f"engine {engine} → {ENGINE}"] if engine != ENGINE else []
    names = {"target": f"weights of {new.settings['policy']['target']}"}
    changes += [
        f"{names.get(kind, kind)} changed"
        for kind in dict.fromkeys([*new.identity, *old.identity])
        if kind != OBSERVATION and new.identity.get(kind) != old.identity.get(kind)
    ]
    before, after = flat(effective(old.settings)), flat(effective(new.settings))
    keys = [key for key in dict.fromkeys([*after, *before]) if before.get(key) != after.get(key)]
    changes += [f"{key} {before.get(key)} → {after.get(key)}" for key in keys]
    return ", ".join(changes[:3]) or NEW_SETTING


def explain(plan: Split, earlier: Mapping[str, tuple[Setting, str]]) -> Split:
    """Return the plan with `new setting` replaced by what changed since a setting of the same label and target ran.

    earlier: Label -> the stored setting, and the `work` that it had.
    """
    texts = {
        setting.label: differences(*earlier[setting.label], setting)
        for setting in plan.study.settings
        if setting.label in earlier
        and earlier[setting.label][0].settings["policy"]["target"] == setting.settings["policy"]["target"]
    }
    reasons = {
        one: texts.get(one.setting.label, why) if why == NEW_SETTING else why for one, why in plan.reasons.items()
    }
    return replace(plan, reasons=reasons)


def plain_settings(settings: Plain) -> dict[str, Any]:
    """Return plain RolloutSettings without the task, as a Setting holds them."""
    return without(settings, {"task"})


def seeds_text(seeds: Iterable[int]) -> str:
    """Return seeds as ranges: (5, 6, 7, 9) -> "5-7;9"."""
    runs: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return ";".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def count(number: int, noun: str) -> str:
    """Return a number with its noun: `1 task`, `2 tasks`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
