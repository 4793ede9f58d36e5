"""Which drafts are good enough (docs/methods.md §2.1). This file imports nothing heavy.

The longest accepted path wins. Of equally long ones the one with the smaller summed distance to the target tokens wins,
and of those the one that was proposed first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from kerv_cli.engine.tree import ROOT, TokenTree

if TYPE_CHECKING:
    from kerv_cli.base.spaces import ActionSpace

Bounds = Sequence[tuple[int, int]]
"""Per DoF: the first DoF of its kinematic group, and one past the last (`ActionSpace.bounds`)."""


class Accepted(NamedTuple):
    """Result of an acceptance rule.

    Attributes:
        path: Nodes of the best accepted path, from depth 0 down.
        rejected: The child of the path's last node that is nearest to the target token; None if it has no children.
    """

    path: tuple[int, ...]
    rejected: int | None


def accept_by_distance(tree: TokenTree, target_tokens: Sequence[int], start: int, limits: Sequence[int]) -> Accepted:
    """Accept a node if its parent is accepted and its token is within its DoF's limit of the target token.

    Args:
        tree: The draft, n nodes.
        target_tokens: 1 + n tokens: the target's after the last committed token, then after each node.
        start: Index in the chunk of the nodes of depth 0.
        limits: Largest accepted distance per DoF, in bins. All zero is strict acceptance.
    """
    alone = [(dof, dof + 1) for dof in range(len(limits))]  # every DoF is a group of its own
    return accept_by_group(tree, target_tokens, start, limits, group_limit=max(limits), bounds=alone)


def accept_by_group(
    tree: TokenTree,
    target_tokens: Sequence[int],
    start: int,
    limits: Sequence[int],
    *,
    group_limit: int,
    bounds: Bounds,
) -> Accepted:
    """Accept or reject a kinematic group of one control step as a whole (HeiSD's `sequence` rule).

    A group is accepted if each of its tokens is within its DoF's limit of the target token after its parent, and if
    these distances sum to at most `group_limit`. A group that is rejected, or that the tree holds only in part, ends
    the path at its first token. `start` may be inside a group. Its remaining tokens are then a group of their own: the
    committed ones are target tokens, because accepted paths end with a whole group and only a bonus begins another.

    Args:
        tree: The draft, n nodes.
        target_tokens: 1 + n tokens: the target's after the last committed token, then after each node.
        start: Index in the chunk of the nodes of depth 0.
        limits: Largest accepted distance per DoF, in bins.
        group_limit: Largest accepted sum of a group's distances, in bins.
        bounds: The group of each DoF.
    """
    alive = [False] * len(tree)  # whether no limit is broken on the path to this node
    in_group = [0] * len(tree)  # distances summed within the node's group
    distances = [0] * len(tree)  # distances summed along the path
    best, best_length, best_distance = ROOT, 0, 0
    for i, (token, parent, depth) in enumerate(zip(tree.tokens, tree.parents, tree.depths, strict=True)):
        if parent != ROOT and not alive[parent]:
            continue
        dof = (start + depth) % len(limits)
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
    """Return the child of `node` (or of ROOT) that is nearest to the target token after it; None without children."""
    children = [i for i, parent in enumerate(tree.parents) if parent == node]
    return min(children, key=lambda i: abs(tree.tokens[i] - target_tokens[node + 1]), default=None)


@dataclass(frozen=True)
class DistanceRule:
    """Base of acceptance rules: accepts a draft token within its DoF's largest distance to the target's token."""

    space: ActionSpace

    def of_drafts_from(self, proposer: str) -> DistanceRule:
        """Return the rule for drafts of `proposer`: this one."""
        return self

    def limits(self, r: int) -> tuple[int, ...]:
        """Return the largest accepted distance per DoF at radius r, in bins (D,)."""
        raise NotImplementedError

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """Return the longest accepted path at radius r. The other arguments are those of `accept_by_distance`."""
        return accept_by_distance(tree, target_tokens, start, self.limits(r))


class StrictRule(DistanceRule):
    """Accepts a draft token that equals the target's: lossless."""

    def limits(self, r: int) -> tuple[int, ...]:
        """Return zero for every DoF (D,)."""
        return (0,) * self.space.dofs
