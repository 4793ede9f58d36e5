"""Acceptance rules: which draft tokens are good enough (docs/methods.md §2.1). Imports neither torch nor numpy.

A path leads from the last committed token down a draft's tree. The longest accepted path wins. Ties go to the path with
the smaller summed distance to the target tokens, then to the path that was proposed first.
"""

from __future__ import annotations

import functools
import itertools
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from kerv_cli.engine.decisions import ROOT, TokenTree
from kerv_cli.engine.parts import Buildable

if TYPE_CHECKING:
    from kerv_cli.base.spaces import ActionSpace


class Accepted(NamedTuple):
    """Result of an acceptance rule: the accepted path of a draft, and the rejected node after that path.

    Attributes:
        path: Indices of the accepted nodes, from depth 0 down. Empty if none was accepted.
        rejected: Index of the rejected node after the path. If there are several, the one whose token is nearest to
            the target's token. None if the path ends at a leaf.
    """

    path: tuple[int, ...]
    rejected: int | None


def accept_by_group(
    tree: TokenTree,
    target_tokens: Sequence[int],
    start: int,
    limits: Sequence[int],
    *,
    group_limit: int,
    bounds: Sequence[tuple[int, int]],
) -> Accepted:
    """Return the longest accepted path, if tokens are accepted by kinematic group (HeiSD's `sequence` rule).

    The tokens of one group (such as position or rotation) in one control step are accepted together or not at all. Each
    token's distance must be within the limit of its DoF, and the distances must sum to at most `group_limit`. A path
    ends before a group that is only partly in the tree. If `start` is inside a group, only the group's tokens from
    `start` on are judged.

    Args:
        limits: Largest accepted distance per DoF, in bins.
        group_limit: Largest accepted sum of a group's distances, in bins.
        bounds: For each DoF, the index of the first DoF of its group, and the index after the group's last DoF.
    """
    alive = [False] * len(tree)  # whether no limit is broken on the path to this node
    in_group = [0] * len(tree)  # distances summed within the node's group
    distances = [0] * len(tree)  # distances summed along the path
    best, best_length, best_distance, dofs = ROOT, 0, 0, len(limits)
    for i, (token, parent, depth) in enumerate(zip(tree.tokens, tree.parents, tree.depths, strict=True)):
        if parent != ROOT and not alive[parent]:
            continue
        dof = (start + depth) % dofs
        first, end = bounds[dof]
        distance = abs(token - target_tokens[parent + 1])
        in_group[i] = distance if parent == ROOT or dof == first else distance + in_group[parent]
        distances[i] = distance if parent == ROOT else distance + distances[parent]
        alive[i] = distance <= limits[dof] and in_group[i] <= group_limit
        is_whole = dof + 1 == end
        if alive[i] and is_whole and (depth + 1, -distances[i]) > (best_length, -best_distance):
            best, best_length, best_distance = i, depth + 1, distances[i]
    return Accepted(tuple(tree.path_to(best)), nearest_child(tree, best, target_tokens))


def nearest_child(tree: TokenTree, node: int, target_tokens: Sequence[int]) -> int | None:
    """Return the child of `node` whose token is nearest to the target's prediction. None if there are no children."""
    children = [i for i, parent in enumerate(tree.parents) if parent == node]
    return min(children, key=lambda i: abs(tree.tokens[i] - target_tokens[node + 1]), default=None)


@dataclass(frozen=True)
class DistanceRule(Buildable):
    """Base class of acceptance rules: accepts a draft token if it is close enough to the target's token."""

    space: ActionSpace

    @classmethod
    def build(cls, settings: Any, context: Any) -> Any:
        return cls(context.target.actions)

    def of_drafts_from(self, proposer: str) -> DistanceRule:
        """Return the rule for drafts of the proposer with this name. The base class returns itself."""
        return self

    def same_limits(self, r: int, strict: bool = True) -> tuple[int, ...]:
        """Return the limit r for each of the D DoFs, in bins. With `strict`, strict DoFs (such as a gripper) get 0."""
        return tuple([0 if strict and one else r for one in self._strict])

    @functools.cached_property
    def _strict(self) -> list[bool]:
        return self.space.strict_tokens(self.space.kinds).tolist()

    @abstractmethod
    def limits(self, r: int) -> tuple[int, ...]:
        """Return the largest accepted distance of each DoF, (D,) in bins, for the acceptance radius `r` in bins.

        FAST tokens belong to no DoF. For them, return a single distance.
        """

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """Return the longest accepted path, and the node that was rejected after it.

        Args:
            tree: The draft, n nodes.
            target_tokens: The target's prediction after the last committed token, then after each of the n nodes.
            start: Number of committed tokens. A node at depth d is token start + d of the chunk.
            r: Acceptance radius, in bins.
        """
        limits = self.limits(r)
        alone = list(itertools.pairwise(range(len(limits) + 1)))  # every DoF is a group of its own
        return accept_by_group(tree, target_tokens, start, limits, group_limit=max(limits), bounds=alone)

    def judge_after(self, tokens: Sequence[int], tree: TokenTree, target_tokens: Sequence[int], r: int) -> Accepted:
        """Judge a draft that follows the committed `tokens`. By default calls `judge` with the number of tokens."""
        return self.judge(tree, target_tokens, len(tokens), r)


class StrictRule(DistanceRule):
    """Accepts only draft tokens that equal the target's. Decoding is then lossless."""

    def limits(self, r: int) -> tuple[int, ...]:
        return (0,) * self.space.kinds
