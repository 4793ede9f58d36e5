"""Which drafts are good enough (METHODS §2.1). Pure functions of tokens; the longest accepted path wins, ties go to the
smaller summed distance, then to the node proposed first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from kerv_cli.drafting.groups import Groups, bounds, kinematic_groups
from kerv_cli.drafting.tree import ROOT, TokenTree
from kerv_cli.errors import UnknownName
from kerv_cli.settings import AcceptanceSettings

Rule = Callable[[TokenTree, Sequence[int], int, Sequence[int]], "Verdict"]


@dataclass(frozen=True)
class Verdict:
    """The best accepted path (node indices, root to leaf) and the best rejected candidate behind it, or None."""

    path: tuple[int, ...]
    rejected: int | None


def accept_by_distance(tree: TokenTree, target_tokens: Sequence[int], start: int, limits: Sequence[int]) -> Verdict:
    """Accept a node when abs(token − verdict at its parent) ≤ the limit of its DoF and its parent was accepted.

    target_tokens: 1 + n target tokens, the first for the position after the last committed token, then after each node.
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
    return Verdict(tuple(tree.path_to(best)), nearest_child(tree, best, target_tokens))


def accept_by_group(
    tree: TokenTree,
    target_tokens: Sequence[int],
    start: int,
    limits: Sequence[int],
    *,
    group_limit: int,
    groups: Groups | None = None,
) -> Verdict:
    """HeiSD's `sequence` rule: a kinematic group of one control step is accepted or not as a whole.

    A group is accepted when its abs biases (token − verdict at its parent) are each ≤ the limit of their DoF and sum to
    at most `group_limit`. A rejected group ends the path at its first token. So does an incomplete one: where a path
    leaves the tree inside a group, that group's tokens are not accepted. `start` may lie inside a group: its remaining
    tokens are then judged as a group of their own, the committed ones' biases being unknown. In the decode loop nothing
    is lost by that: accepted paths end with a group, so what is committed of a begun group are target_tokens, with bias 0.

    target_tokens, start, limits: as in `accept_by_distance`. groups: default `kinematic_groups(D)`. `rejected` is the first
    token of the group that ended the path.
    """
    dofs = len(limits)
    group_of = bounds(groups or kinematic_groups(dofs))
    alive = [False] * len(tree)  # no limit is broken down to this node
    biases = [0] * len(tree)  # summed within the node's group
    distances = [0] * len(tree)  # summed along the path
    best, best_length, best_distance = ROOT, 0, 0
    for i, (token, parent, depth) in enumerate(zip(tree.tokens, tree.parents, tree.depths, strict=True)):
        if parent != ROOT and not alive[parent]:
            continue
        dof = (start + depth) % dofs
        first, end = group_of[dof]
        bias = abs(token - target_tokens[parent + 1])
        biases[i] = bias if parent == ROOT or dof == first else bias + biases[parent]
        alive[i] = bias <= limits[dof] and biases[i] <= group_limit
        distances[i] = bias if parent == ROOT else bias + distances[parent]
        if not alive[i] or dof + 1 != end:
            continue
        if depth + 1 > best_length or (depth + 1 == best_length and distances[i] < best_distance):
            best, best_length, best_distance = i, depth + 1, distances[i]
    return Verdict(tuple(tree.path_to(best)), nearest_child(tree, best, target_tokens))


def nearest_child(tree: TokenTree, node: int, target_tokens: Sequence[int]) -> int | None:
    """The child of `node` that is closest to the verdict there."""
    children = [i for i, parent in enumerate(tree.parents) if parent == node]
    return min(children, key=lambda i: abs(tree.tokens[i] - target_tokens[node + 1]), default=None)


def limits_of(settings: AcceptanceSettings, r: int, dofs: int, gripper: int) -> tuple[int, ...]:
    """Bins per DoF under this rule: `r`, or the rule's own. The gripper of `sequence` is exact."""
    if settings.kind == "strict":
        return (0,) * dofs
    limits = [settings.token_limit if settings.kind == "sequence" else r] * dofs
    if settings.strict_gripper or settings.kind == "sequence":
        limits[gripper] = 0
    return tuple(limits)


def judging(settings: AcceptanceSettings, proposer: str) -> AcceptanceSettings:
    """The rule for drafts of `proposer`: `hybrid` judges retrieved ones by `sequence` and all others by `relaxed`."""
    if settings.kind != "hybrid":
        return settings
    return replace(settings, kind="sequence" if proposer == "retrieval" else "relaxed")


def acceptance_rule(settings: AcceptanceSettings) -> Rule:
    rules: dict[str, Rule] = {
        "strict": accept_by_distance,
        "relaxed": accept_by_distance,
        "hybrid": accept_by_distance,
        "sequence": partial(accept_by_group, group_limit=settings.group_limit),
    }
    if settings.kind not in rules:
        raise UnknownName("acceptance.kind", settings.kind, rules)
    return rules[settings.kind]
