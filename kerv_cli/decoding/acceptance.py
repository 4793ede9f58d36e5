"""Which drafts are good enough (METHODS §2.1). Pure functions of tokens; the longest accepted path wins, ties go to the
smaller summed distance, then to the node proposed first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from kerv_cli.drafting.tree import ROOT, TokenTree
from kerv_cli.errors import UnknownName
from kerv_cli.settings import AcceptanceSettings

Rule = Callable[[TokenTree, Sequence[int], int, Sequence[int]], "Verdict"]


@dataclass(frozen=True)
class Verdict:
    """The best accepted path (node indices, root to leaf) and the best rejected candidate behind it, or None."""

    path: tuple[int, ...]
    rejected: int | None


def accept_by_distance(tree: TokenTree, verdicts: Sequence[int], start: int, limits: Sequence[int]) -> Verdict:
    """Accept a node when abs(token − verdict at its parent) ≤ the limit of its DoF and its parent was accepted.

    verdicts: 1 + n target tokens, the first for the position after the last committed token, then after each node.
    start: index in the chunk of the nodes of depth 0. limits: r per DoF, in bins; all zero is strict.
    """
    dofs = len(limits)
    lengths = [0] * len(tree)  # accepted length down to this node; 0: rejected
    distances = [0] * len(tree)
    best, best_length, best_distance = ROOT, 0, 0
    for i, (token, parent, depth) in enumerate(zip(tree.tokens, tree.parents, tree.depths, strict=True)):
        if parent != ROOT and not lengths[parent]:
            continue
        distance = abs(token - verdicts[parent + 1])
        if distance > limits[(start + depth) % dofs]:
            continue
        lengths[i] = depth + 1
        distances[i] = distance + (distances[parent] if parent != ROOT else 0)
        if lengths[i] > best_length or (lengths[i] == best_length and distances[i] < best_distance):
            best, best_length, best_distance = i, lengths[i], distances[i]
    return Verdict(tuple(tree.path_to(best)), nearest_child(tree, best, verdicts))


def nearest_child(tree: TokenTree, node: int, verdicts: Sequence[int]) -> int | None:
    """The child of `node` that is closest to the verdict there."""
    children = [i for i, parent in enumerate(tree.parents) if parent == node]
    return min(children, key=lambda i: abs(tree.tokens[i] - verdicts[node + 1]), default=None)


def limits_of(settings: AcceptanceSettings, r: int, dofs: int, gripper: int) -> tuple[int, ...]:
    """r per DoF under this rule."""
    if settings.kind == "strict":
        return (0,) * dofs
    limits = [r] * dofs
    if settings.strict_gripper:
        limits[gripper] = 0
    return tuple(limits)


def acceptance_rule(settings: AcceptanceSettings) -> Rule:
    rules: dict[str, Rule] = {"strict": accept_by_distance, "relaxed": accept_by_distance}
    if settings.kind not in rules:
        raise UnknownName("acceptance.kind", settings.kind, rules)
    return rules[settings.kind]
