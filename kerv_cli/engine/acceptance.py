"""Which drafts are good enough (docs/methods.md §2.1). Pure functions of tokens; the longest accepted path wins, ties
go to the smaller summed distance, then to the node proposed first. Nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from kerv_cli.engine.tree import ROOT, TokenTree

if TYPE_CHECKING:
    from kerv_cli.base.spaces import ActionSpace

Bounds = Sequence[tuple[int, int]]
"""Per DoF: the first DoF of its kinematic group, and one past the last (`ActionSpace.bounds`)."""


@dataclass(frozen=True)
class Accepted:
    """Result of an acceptance rule. path: node indices of the best accepted path, from depth 0 down. rejected: the
    child of its last node that is nearest to the target token there; None without children."""

    path: tuple[int, ...]
    rejected: int | None


def accept_by_distance(tree: TokenTree, target_tokens: Sequence[int], start: int, limits: Sequence[int]) -> Accepted:
    """Accepts a node when its parent is accepted and abs(token − target token behind the parent) ≤ its DoF's limit.

    target_tokens: 1 + n, the first for the position after the last committed token, then after each node.
    start: index in the chunk of the nodes of depth 0. limits: r per DoF, in bins; all zero is strict.
    """
    dofs = len(limits)
    lengths = [0] * len(tree)  # accepted length down to this node; 0: rejected
    distances = [0] * len(tree)
    best, best_length, best_distance = ROOT, 0, 0
    for i, (token, parent, depth) in enumerate(zip(tree.tokens, tree.parents, tree.depths, strict=True)):
        if parent != ROOT and not lengths[parent]:
            continue
        distance = abs(token - target_tokens[parent + 1])
        if distance > limits[(start + depth) % dofs]:
            continue
        lengths[i] = depth + 1
        distances[i] = distance + (distances[parent] if parent != ROOT else 0)
        if lengths[i] > best_length or (lengths[i] == best_length and distances[i] < best_distance):
            best, best_length, best_distance = i, lengths[i], distances[i]
    return Accepted(tuple(tree.path_to(best)), nearest_child(tree, best, target_tokens))


def accept_by_group(
    tree: TokenTree,
    target_tokens: Sequence[int],
    start: int,
    limits: Sequence[int],
    *,
    group_limit: int,
    bounds: Bounds,
) -> Accepted:
    """HeiSD's `sequence` rule: a kinematic group of one control step is accepted or not as a whole.

    A group is accepted when the biases of its tokens, abs(token − target token behind its parent), are each ≤ the limit
    of their DoF and sum to at most `group_limit`. A rejected group ends the path at its first token. So does an
    incomplete one: where a path leaves the tree inside a group, that group's tokens are not accepted. `start` may lie
    inside a group: its remaining tokens are then judged as a group of their own. In the decode loop the committed ones
    are target tokens, with bias 0: accepted paths end with a whole group, and only a bonus begins another.

    target_tokens, start, limits: as in `accept_by_distance`. `rejected` is the first token of the group that ended the
    path.
    """
    dofs = len(limits)
    alive = [False] * len(tree)  # no limit is broken down to this node
    biases = [0] * len(tree)  # summed within the node's group
    distances = [0] * len(tree)  # summed along the path
    best, best_length, best_distance = ROOT, 0, 0
    for i, (token, parent, depth) in enumerate(zip(tree.tokens, tree.parents, tree.depths, strict=True)):
        if parent != ROOT and not alive[parent]:
            continue
        dof = (start + depth) % dofs
        first, end = bounds[dof]
        bias = abs(token - target_tokens[parent + 1])
        biases[i] = bias if parent == ROOT or dof == first else bias + biases[parent]
        alive[i] = bias <= limits[dof] and biases[i] <= group_limit
        distances[i] = bias if parent == ROOT else bias + distances[parent]
        if not alive[i] or dof + 1 != end:
            continue
        if depth + 1 > best_length or (depth + 1 == best_length and distances[i] < best_distance):
            best, best_length, best_distance = i, depth + 1, distances[i]
    return Accepted(tuple(tree.path_to(best)), nearest_child(tree, best, target_tokens))


def nearest_child(tree: TokenTree, node: int, target_tokens: Sequence[int]) -> int | None:
    """The child of `node` (or ROOT) whose token is nearest to the target token behind `node`; None without children."""
    children = [i for i, parent in enumerate(tree.parents) if parent == node]
    return min(children, key=lambda i: abs(tree.tokens[i] - target_tokens[node + 1]), default=None)


class Acceptance(Protocol):
    """An acceptance rule: which nodes of a draft are as good as the target's tokens."""

    def of_drafts_from(self, proposer: str) -> Acceptance:
        """The rule for drafts of `proposer`."""

    def limits(self, r: int) -> tuple[int, ...]:
        """Largest accepted distance per DoF at radius r, bins (D,)."""

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """The longest accepted path; arguments as `accept_by_distance`, r in bins."""


@dataclass(frozen=True)
class DistanceRule:
    """Base of acceptance rules: accepts a draft token within its DoF's largest distance to the target's token."""

    space: ActionSpace

    def of_drafts_from(self, proposer: str) -> Acceptance:
        """Return the rule for drafts of `proposer`: this one."""
        return self

    def limits(self, r: int) -> tuple[int, ...]:
        """Return the largest accepted distance per DoF at radius r, in bins (D,)."""
        raise NotImplementedError

    def judge(self, tree: TokenTree, target_tokens: Sequence[int], start: int, r: int) -> Accepted:
        """Return the longest path within the limits. The arguments are those of `accept_by_distance`."""
        return accept_by_distance(tree, target_tokens, start, self.limits(r))


class StrictRule(DistanceRule):
    """Accepts a draft token that equals the target's: lossless."""

    def limits(self, r: int) -> tuple[int, ...]:
        """Return zero for every DoF (D,)."""
        return (0,) * self.space.dofs
