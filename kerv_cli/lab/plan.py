"""The episodes of a study: which exist in the database, which are missing and why, and in which blocks they run.

A block is a group of episodes that one process runs, with the settings taking turns.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeVar

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.episodes.identity import Setting, differences

MOST_EPISODES = 1_000_000
"""Largest number of episodes in a study."""

NEVER, ALL = "never", "all"
"""Values of `rerun=`, which says which existing episodes to run again."""

Key = tuple[str, str, int]
"""A setting's hash `work`, task and seed. Equal keys mean the same episode in any study."""
K = TypeVar("K")


@dataclass(frozen=True)
class Episode:
    """One episode of a study."""

    setting: Setting
    task: str
    seed: int

    @property
    def key(self) -> Key:
        return self.setting.work, self.task, self.seed

    @property
    def recording(self) -> str:
        name = f"{self.setting.label.replace('=', '')}-{self.task}-{self.seed}-{self.setting.work[:6]}.rrd"
        return re.sub(r"[^\w.+-]", "_", name)[-200:]


def all_episodes(settings: Sequence[Setting], tasks: Iterable[str], block: int = 5) -> tuple[Episode, ...]:
    """Return every episode of these settings, ordered by task and block of seeds.

    Args:
        settings: The settings to compare.
        tasks: Names of the tasks.
        block: Number of seeds in a block. All settings run these seeds before the next block begins.
    """
    tasks = list(dict.fromkeys(tasks))
    numbers = [setting.settings["episodes"] for setting in settings]
    total = len(tasks) * sum(numbers)
    if total > MOST_EPISODES:
        raise UsageError(f"the study has {total} episodes: at most {MOST_EPISODES} are allowed")
    episodes: list[Episode] = []
    for task, first in itertools.product(tasks, range(0, max(numbers, default=0), block)):
        for setting, number in zip(settings, numbers, strict=True):
            start = setting.settings["seed"]
            seeds = range(start, start + number)[first : first + block]
            episodes += [Episode(setting, task, seed) for seed in seeds]
    return tuple(episodes)


@dataclass(frozen=True)
class Block:
    """Episodes of one task, which one process runs. The settings take turns, seed by seed."""

    episodes: tuple[Episode, ...]

    @property
    def task(self) -> str:
        return self.episodes[0].task

    @functools.cached_property
    def settings(self) -> tuple[Setting, ...]:
        return tuple({one.setting.work: one.setting for one in self.episodes}.values())

    @property
    def seeds(self) -> list[int]:
        return sorted(set(map(attrgetter("seed"), self.episodes)))

    @property
    def title(self) -> str:
        return f"{self.task} {seeds_text(self.seeds)}: {count(len(self.settings), 'setting')} in turn"

    def turns(self) -> Iterator[Episode]:
        """Yield the episodes in the order in which they run.

        They run seed by seed. For each seed the settings' order is random but reproducible.
        """
        import numpy as np

        for seed, turn in sorted(grouped(self.episodes, attrgetter("seed")).items()):
            digest = hashlib.sha256(f"{self.task} {seed}".encode()).digest()
            for index in np.random.default_rng(list(digest)).permutation(len(turn)):
                yield turn[int(index)]


def split(
    episodes: Sequence[Episode],
    block: int,
    stored: Mapping[Key, Sequence[Any]],
    known: Mapping[Episode, Any],
    rerun: str,
    earlier: Mapping[str, Setting],
) -> tuple[dict[Episode, int], dict[Episode, str]]:
    """Divide a study's episodes into existing and missing ones.

    Args:
        episodes: The study's episodes.
        block: Number of seeds in a block, which one process runs.
        stored: Rows of stored episodes, by `Episode.key`, with `id`, `block`, and the block's `started` and `seeds`.
        known: The study's rows in the table WANTED. A row that has an episode keeps this episode. A row that an earlier
            ALL has emptied counts as missing until it has run.
        rerun: Which existing episodes to run again, NEVER or ALL.
        earlier: The newest stored setting by label. Used to explain what has changed.

    Returns:
        Two mappings: from each existing episode to its row number, and from each missing episode to the reason for
        running it.
    """
    usable: dict[Episode, list[Any]] = {}
    for one in episodes:
        row, rows = known.get(one), list(stored.get(one.key, ()))
        linked = [each for each in rows if row is not None and each.id == row.episode_id]
        is_anew = rerun == ALL or (row is not None and row.anew and not linked)
        usable[one] = [] if is_anew else linked or rows
    _keep_whole_orders(usable, block)
    existing = {one: max(row.id for row in rows) for one, rows in usable.items() if rows}
    works, tasks = {work for work, _, _ in stored}, {(work, task) for work, task, _ in stored}
    change = functools.cache(lambda setting: differences(setting, earlier.get(setting.label)))
    missing = {}
    for one in episodes:
        if one in existing:
            continue
        if stored.get(one.key):
            is_ordered = one.setting.depends_on_order and rerun != ALL
            missing[one] = "order of episodes" if is_ordered else "rerun=all"
        elif one.key[:2] in tasks:
            missing[one] = "new seeds"
        else:
            missing[one] = "new task" if one.setting.work in works else change(one.setting)
    return existing, missing


def grouped(episodes: Iterable[Episode], key: Callable[[Episode], K]) -> dict[K, list[Episode]]:
    groups: dict[K, list[Episode]] = {}
    for one in episodes:
        groups.setdefault(key(one), []).append(one)
    return groups


def ordered_parts(episodes: Iterable[Episode], block: int) -> list[list[Episode]]:
    """Return groups of episodes that must run together, in order, because each may change the results of the next.

    A group holds one setting and task, and `block` successive seeds. Episodes of settings whose results do not
    depend on the order are left out.
    """

    def key(one: Episode) -> tuple[str, str, int]:
        return one.setting.work, one.task, (one.seed - one.setting.settings["seed"]) // block

    return list(grouped(filter(attrgetter("setting.depends_on_order"), episodes), key).values())


def _keep_whole_orders(usable: dict[Episode, list[Any]], block: int) -> None:
    """Remove from `usable` the stored rows that cannot be reused because their episodes ran in another order.

    This concerns only settings whose results depend on the order of their episodes. Their rows are kept if a single
    block ran exactly the seeds that the study keeps together.

    Args:
        usable: The stored rows of each episode. The lists are replaced.
        block: Number of seeds that the study keeps together.
    """
    sizes = Counter(map(attrgetter("block"), itertools.chain(*usable.values())))
    for part in ordered_parts(usable, block):
        seeds = seeds_text(map(attrgetter("seed"), part))
        by_block: dict[str, list[Any]] = {}
        for row in itertools.chain(*map(usable.__getitem__, part)):
            if row.seeds == seeds:
                by_block.setdefault(row.block, []).append(row)
        whole = [rows for rows in by_block.values() if len(rows) == len(part)]
        best = max(whole, key=lambda rows: (sizes[rows[0].block], rows[0].started, rows[0].id), default=[])
        for one, row in itertools.zip_longest(part, best):
            usable[one] = [row] if row else []


def blocks_of(episodes: Iterable[Episode], block: int) -> list[Block]:
    """Group episodes into blocks, each to be run by one process.

    The episodes of a block have the same task and the same number of threads. They have up to `block`
    successive seeds. All seeds of a block run the same settings: seeds for which other settings must run get a block of
    their own. But if a setting's results depend on the order of its seeds, its seeds are never split.

    Args:
        episodes: The episodes to run.
        block: Largest number of seeds in a block.
    """
    groups: dict[tuple[object, ...], list[Episode]] = {}
    for (task, seed), turn in grouped(episodes, lambda one: (one.task, one.seed)).items():
        for threads, part in grouped(turn, lambda one: one.setting.settings["runtime"]["threads"]).items():
            index = (seed - min(one.setting.settings["seed"] for one in part)) // block
            ordered = list(filter(attrgetter("setting.depends_on_order"), part))
            same = sorted(map(attrgetter("setting.work"), ordered or part))
            groups.setdefault((task, threads, index, *same), []).extend(part)
    return list(map(Block, map(tuple, groups.values())))


def seeds_text(seeds: Iterable[int]) -> str:
    """Write seeds as ranges: (5, 6, 7, 9) becomes "5-7;9"."""
    runs: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return ";".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)
