"""Count how many draft tokens of a study's settings were accepted, by place, from the stored rounds of all decodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow.compute as pc

from kerv_cli.engine.tally import Tally
from kerv_cli.lab.store import StudyStore

_AT_ONCE = 200  # episodes in memory at a time


def tally_of(store: StudyStore, episodes: Sequence[int]) -> Tally | None:
    """Count the verifications of some episodes of one setting. None if their decodes verified no draft.

    Args:
        store: The study.
        episodes: Row numbers of the episodes.
    """
    total = None
    for first in range(0, len(episodes), _AT_ONCE):
        part = list(episodes[first : first + _AT_ONCE])
        rounds = store.decodes(part, ("rounds",))["rounds"].combine_chunks().flatten()
        is_verification = pc.and_(pc.greater(rounds.field("tree_size"), 0), pc.not_equal(rounds.field("mode"), "skip"))
        rounds = rounds.filter(is_verification)
        if not len(rounds):
            continue
        start, accepted, nodes = (rounds.field(name).to_numpy() for name in ("start", "accepted", "tree_size"))
        judged = pc.list_value_length(rounds.field("drafted")).to_numpy().astype(np.int64)
        tally = Tally.of(start, judged, accepted, nodes, _dofs(store, part[0]))
        total = tally if total is None else total + tally
    return total


def _dofs(store: StudyStore, episode: int) -> int:
    """Return the number of DoFs of an episode's actions."""
    return len(store.decodes([episode], ("actions",))["actions"][0].as_py()[0])
