"""Calibrates verify-skip (docs/methods.md §4.3; HeiSD): the similarity s_min of each task, from a datastore.

An entry's key is looked up among the other episodes of its task, and the best neighbour's chunk is compared with the
entry's own, the expert's next actions. The neighbour's chunk would have been executed without verification.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.errors import UnknownName
from kerv_cli.methods.calibration import NEVER, SkipLevel, SkipSection
from kerv_cli.worlds.demos.dataset import OnProgress

if TYPE_CHECKING:
    from kerv_cli.methods.heisd.datastore import Datastore

ENTRIES = 4000  # looked up per task, evenly spread; on MT10, levels from 1000 did not hold on other episodes
LEAST = 20  # entries above a level; fewer do not support it
LOW, HIGH = 2.0, 1 / 3  # wrong chunks that the bounds of s_min allow, as multiples of what s_min itself allows


@dataclass(frozen=True)
class Matches:
    """n entries of one task and their best neighbours in other episodes."""

    similarity: np.ndarray  # (n,) float32, cosine
    error: np.ndarray  # (n,) mean absolute difference of the two chunks, normalised action units
    strict: np.ndarray  # (n,) bool, some token of a strict DoF differs

    def good(self, epsilon: float) -> np.ndarray:
        """(n,) bool: the error is at most epsilon and all tokens of strict DoFs are the expert's. The gripper is judged
        apart, because a wrong one hardly changes the mean over all DoFs and drops the object."""
        return (self.error <= epsilon) & ~self.strict


def neighbours_elsewhere(store: Datastore, task: str, entries: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Leave-one-episode-out: up to `entries` evenly spread entries of `task` and their best neighbours in other
    episodes.

    Rows (n,), cosines (n,) float32 and the neighbours' chunks (n, N) int64; n is 0 where the datastore holds a single
    episode of the task.

    Raises:
        UnknownName: a task that the datastore does not hold.
    """
    if task not in store.shards:
        raise UnknownName("task of the datastore", task, store.shards)
    shard = store.shards[task]
    count = min(entries, shard.stop - shard.start) if len(np.unique(store.seeds[shard])) > 1 else 0
    rows = np.linspace(shard.start, shard.stop - 1, count).astype(int)
    similarity, chunks = np.zeros(count, np.float32), np.zeros((count, store.tokens.shape[1]), np.int64)
    for i, row in enumerate(rows):
        neighbours = store.query(store.vectors[row], task, 1, without=int(store.seeds[row]))
        similarity[i], chunks[i] = neighbours.similarity[0], neighbours.chunks[0]
    return rows, similarity, chunks


def match(store: Datastore, task: str) -> Matches:
    """The entries of `neighbours_elsewhere`, with the neighbours' chunks compared to their own."""
    space = store.manifest.actions
    rows, similarity, drafts = neighbours_elsewhere(store, task, ENTRIES)
    expert = store.tokens[rows].astype(np.int64)
    error = np.abs(space.values_of(drafts) - space.values_of(expert)).mean(1)
    strict = (drafts != expert)[:, space.strict_tokens(expert.shape[1])].any(1)
    return Matches(similarity, error, strict)


def lowest_level(similarity: np.ndarray, good: np.ndarray, confidence: float, least: int = LEAST) -> float | None:
    """The lowest similarity s such that of the entries with similarity ≥ s at least the share `confidence` is good.

    similarity (n,), good (n,) bool. Entries of equal similarity count together. None where no level has `least`
    entries above it and enough good ones among them.
    """
    order = np.argsort(-similarity, kind="stable")
    ranked = similarity[order]
    above = np.arange(1, len(ranked) + 1)
    enough = (np.cumsum(good[order]) / above >= confidence) & (above >= least)
    enough[:-1] &= ranked[:-1] > ranked[1:]
    return float(ranked[enough][-1]) if enough.any() else None


def task_levels(matches: Matches, epsilon: float, confidence: float) -> SkipLevel:
    """s_min of one task, the bounds between which feedback may move it, and the share of decodes it would skip.

    low ≤ s_min ≤ high: the same level where twice and where a third of the wrong chunks are allowed (at a confidence
    of 0.9: 0.8 and 0.967). Where no level is that good, high is the largest similarity seen, where hardly
    anything is skipped. A task without an s_min has NEVER for all three and never skips.
    """
    good, wrong = matches.good(epsilon), 1 - confidence
    s_min = lowest_level(matches.similarity, good, confidence)
    if s_min is None:
        return SkipLevel(NEVER, NEVER, NEVER, share=0.0, entries=len(matches.similarity))
    low, high = (lowest_level(matches.similarity, good, 1 - wrong * factor) for factor in (LOW, HIGH))
    skipped = matches.similarity >= s_min
    return SkipLevel(
        s_min,
        low=s_min if low is None else min(low, s_min),
        high=float(matches.similarity.max()) if high is None else max(high, s_min),
        share=float(skipped.mean()),
        entries=len(matches.similarity),
        within=float(good[skipped].mean()),
        error=float(matches.error[skipped].mean()),
    )


def skip_section(
    store: Datastore,
    tasks: Sequence[str],
    epsilon: float,
    confidence: float,
    on_progress: OnProgress,
) -> SkipSection | None:
    """The calibration's section `skip`: levels of those `tasks` that the datastore holds, and its hash. None where it
    holds none of them."""
    levels = {}
    for done, task in enumerate(tasks, 1):
        if task in store.shards:
            levels[task] = task_levels(match(store, task), epsilon, confidence)
        on_progress(done, len(tasks))
    return SkipSection(store.content, epsilon, confidence, levels) if levels else None
