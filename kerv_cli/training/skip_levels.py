"""Calibrate verify-skip: the similarity s_min of each task, from a datastore (docs/methods.md §4.3; HeiSD).

Each entry is looked up among the other episodes of its task. The best neighbour's chunk, which would have been executed
without verification, is compared with the entry's own: the expert's next actions.
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

ENTRIES = 4000
"""Entries looked up per task, evenly spread. On MT10, levels from 1000 did not hold on other episodes."""
LEAST = 20
"""Entries that must be above a level to support it."""
LOW, HIGH = 2.0, 1 / 3
"""The bounds of s_min allow this multiple of the wrong chunks that s_min allows."""


@dataclass(frozen=True)
class Matches:
    """n entries of one task and their best neighbours in other episodes."""

    similarity: np.ndarray  # (n,) float32, cosine
    error: np.ndarray  # (n,) mean absolute difference of the two chunks, normalised action units
    strict: np.ndarray  # (n,) bool, whether a token of a strict DoF differs

    def good(self, epsilon: float) -> np.ndarray:
        """Return (n,) bool: the error is at most epsilon, and all tokens of strict DoFs are the expert's.

        The gripper is judged apart: a wrong one hardly changes the mean over all DoFs, but drops the object.
        """
        return (self.error <= epsilon) & ~self.strict


def match(store: Datastore, task: str) -> Matches:
    """Compare up to ENTRIES entries of a task with their best neighbours in other episodes; none for one episode.

    Raises:
        UnknownName: The datastore does not hold the task.
    """
    if task not in store.shards:
        raise UnknownName("task of the datastore", task, store.shards)
    shard = store.shards[task]
    count = min(ENTRIES, shard.stop - shard.start) if len(np.unique(store.seeds[shard])) > 1 else 0
    rows = np.linspace(shard.start, shard.stop - 1, count).astype(int)
    similarity, drafts = np.zeros(count, np.float32), np.zeros((count, store.tokens.shape[1]), np.int64)
    for i, row in enumerate(rows):
        neighbours = store.query(store.vectors[row], task, 1, without=int(store.seeds[row]))
        similarity[i], drafts[i] = neighbours.similarity[0], neighbours.chunks[0]
    space, expert = store.manifest.actions, store.tokens[rows].astype(np.int64)
    error = np.abs(space.values_of(drafts) - space.values_of(expert)).mean(1)
    strict = (drafts != expert)[:, space.strict_tokens(expert.shape[1])].any(1)
    return Matches(similarity, error, strict)


def lowest_level(similarity: np.ndarray, good: np.ndarray, confidence: float, least: int = LEAST) -> float | None:
    """Return the lowest similarity s such that at least the share `confidence` of the entries from s on is good.

    Entries of equal similarity count together.

    Args:
        similarity: (n,) of the entries.
        good: (n,) bool.
        confidence: Share of good entries.
        least: Entries that a level needs.

    Returns:
        The similarity; None if no level has that many good entries.
    """
    order = np.argsort(-similarity, kind="stable")
    ranked = similarity[order]
    above = np.arange(1, len(ranked) + 1)
    enough = (np.cumsum(good[order]) / above >= confidence) & (above >= least)
    enough[:-1] &= ranked[:-1] > ranked[1:]
    return float(ranked[enough][-1]) if enough.any() else None


def task_levels(matches: Matches, epsilon: float, confidence: float) -> SkipLevel:
    """Return a task's s_min, the bounds between which feedback may move it, and the share of decodes it would skip.

    The bounds low ≤ s_min ≤ high allow twice and a third of the wrong chunks: 0.8 and 0.967 for a confidence of 0.9. If
    no level is good enough for high, it is the largest similarity seen. If none is for s_min, all three are NEVER.
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
    store: Datastore, tasks: Sequence[str], epsilon: float, confidence: float, progress: OnProgress
) -> SkipSection | None:
    """Return the levels of those tasks that the datastore holds; None if it holds none of them."""
    levels = {}
    for done, task in enumerate(tasks, 1):
        if task in store.shards:
            levels[task] = task_levels(match(store, task), epsilon, confidence)
        progress(done, len(tasks))
    return SkipSection(store.content, epsilon, confidence, levels) if levels else None
