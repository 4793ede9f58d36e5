"""Count how many draft tokens the target accepted, by their position (docs/methods.md §7).

A token is *reached* (or *judged*) if the target accepted all tokens before it in its draft.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from kerv_cli.engine.record import DecodeRecord

if TYPE_CHECKING:
    import pyarrow as pa

# Columns of stored decodes that `Tally.of_rounds` reads
_FIELDS = ("mode", "start", "tree_size", "accepted", "drafted", "target_tokens", "threshold")
READ = tuple(map("rounds.list.element.{}".format, _FIELDS))


@dataclass(frozen=True)
class Tally:
    """Counts over the verifications of some decodes."""

    nodes: int  # number of verified draft tokens. In a tree, tokens that are not on the accepted path count, too.
    lengths: np.ndarray  # entry k is the number of verifications that accepted k draft tokens
    # entry k is the number of verifications that judged k: the accepted tokens and the first rejected one
    judged: np.ndarray
    reached: np.ndarray  # (D,) number of judged tokens of each DoF
    accepted: np.ndarray  # (D,) number of accepted tokens of each DoF
    drift: np.ndarray  # (D,) sum over these of draft token − target's token, in bins

    @classmethod
    def of(
        cls,
        start: np.ndarray,
        judged: np.ndarray,
        accepted: np.ndarray,
        nodes: np.ndarray,
        differences: np.ndarray,
        dofs: int,
    ) -> Tally:
        """Count n verifications.

        Args:
            start: (n,) number of tokens committed before each verification.
            judged: (n,) number of judged tokens: the accepted tokens, and the first rejected token if there is one.
            accepted: (n,) number of accepted draft tokens.
            nodes: (n,) number of verified draft tokens.
            differences: Draft token − target's token, of all judged tokens one after the other.
            dofs: Number of DoFs D.
        """
        position = np.arange(judged.sum()) - np.repeat(np.cumsum(judged) - judged, judged)
        dof, taken = (np.repeat(start, judged) + position) % dofs, position < np.repeat(accepted, judged)
        counts = (np.bincount(accepted), np.bincount(judged), np.bincount(dof, minlength=dofs))
        accepted_dof = dof[taken]
        drift = np.bincount(accepted_dof, differences[taken], minlength=dofs).astype(np.int64)
        return cls(int(nodes.sum()), *counts, np.bincount(accepted_dof, minlength=dofs), drift)

    @classmethod
    def of_records(cls, decodes: Iterable[DecodeRecord], dofs: int) -> Tally:
        numbers: list[tuple[int, int, int, int]] = []
        differences: list[int] = []
        for decode in decodes:
            for one in filter(attrgetter("is_verification"), decode.rounds):
                numbers.append((one.start, len(one.drafted), one.accepted, one.tree_size))
                differences += map(int.__sub__, one.drafted, one.target_tokens)
        start, judged, accepted, nodes = np.array(numbers, int).reshape(-1, 4).T
        return cls.of(start, judged, accepted, nodes, np.array(differences, int), dofs)

    @classmethod
    def of_rounds(cls, rounds: pa.StructArray) -> Tally:
        """Count the verifications among some rounds of one setting, as they are stored (rows.DECODE_SCHEMA)."""
        import pyarrow.compute as pc

        is_verification = pc.and_(pc.greater(rounds.field("tree_size"), 0), pc.not_equal(rounds.field("mode"), "skip"))
        rounds = rounds.filter(is_verification)
        start, accepted, nodes = rounds.field("start"), rounds.field("accepted"), rounds.field("tree_size")
        drafted, targets = rounds.field("drafted"), rounds.field("target_tokens")
        judged, given = (pc.list_value_length(lists).to_numpy().astype(np.int64) for lists in (drafted, targets))
        # a bonus may follow the target's tokens at the judged places
        places = np.arange(judged.sum()) + np.repeat(np.cumsum(given) - given - np.cumsum(judged) + judged, judged)
        differences = drafted.flatten().to_numpy() - targets.flatten().to_numpy()[places]
        dofs = len(rounds.field("threshold")[0]) if len(rounds) else 0
        return cls.of(start.to_numpy(), judged, accepted.to_numpy(), nodes.to_numpy(), differences, dofs)

    def __add__(self, other: Tally) -> Tally:
        counts = attrgetter("lengths", "judged", "reached", "accepted", "drift")
        return Tally(self.nodes + other.nodes, *map(_sum, counts(self), counts(other)))

    @property
    def drafts(self) -> int:
        return int(self.lengths.sum())

    @property
    def by_position(self) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of reached tokens and of accepted tokens, each by position in the draft."""
        reached, accepted = self.judged[::-1].cumsum()[::-1][1:], self.lengths[::-1].cumsum()[::-1][1:]
        return reached, _sum(np.zeros(len(reached), int), accepted)

    def as_dict(self) -> dict[str, Any]:
        """Return the measures for JSON, under vLLM's names where vLLM has one (docs/methods.md §7)."""
        reached, accepted = self.by_position
        drafts, tokens = self.drafts, int(accepted.sum())
        return {
            "num_drafts": drafts,
            "num_draft_tokens": self.nodes,
            "num_accepted_tokens": tokens,
            "num_accepted_tokens_per_pos": accepted.tolist(),
            "mean_acceptance_length": 1 + tokens / drafts if drafts else None,
            "draft_acceptance_rate": tokens / self.nodes if self.nodes else None,
            "per_position_acceptance_rate": (accepted / max(1, drafts)).tolist(),
            "acceptance_histogram": self.lengths.tolist(),
            "num_reached_tokens_per_pos": reached.tolist(),
            "conditional_acceptance_rate_per_pos": rates(reached, accepted),
            "num_reached_tokens_per_dof": self.reached.tolist(),
            "conditional_acceptance_rate_per_dof": rates(self.reached, self.accepted),
            "mean_accepted_difference_per_dof": rates(self.accepted, self.drift),
        }


def rates(reached: np.ndarray, accepted: np.ndarray) -> list[float | None]:
    """Return `accepted` ÷ `reached`, entry by entry. An entry is None if `reached` is 0."""
    return [part / whole if whole else None for whole, part in zip(reached.tolist(), accepted.tolist(), strict=True)]


def _sum(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    total = np.zeros(max(len(first), len(second)), int)
    for counts in (first, second):
        total[: len(counts)] += counts
    return total
