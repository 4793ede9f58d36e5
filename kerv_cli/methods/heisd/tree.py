"""Merge stored chunks into one draft tree of kinematic groups (docs/methods.md §4.2)."""

from __future__ import annotations

import functools
import math
from heapq import heappop, heappush
from itertools import count

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.tree import ROOT

CROSS = 0.1  # assumed probability that a path of retrieved groups changes to another neighbour after a group


def neighbour_tree(
    chunks: np.ndarray, start: int, space: ActionSpace, nodes: int = 50, depth: int | None = None, cross: float = CROSS
) -> Draft:
    """Merge the neighbours' chunks into one tree of kinematic groups (docs/methods.md §4.2).

    A kinematic group is the position, rotation or gripper tokens of one control step. Every path of the tree consists
    of whole groups. After a group, a path may continue with the next group of any neighbour. There is one exception: a
    group of strict DoFs (the gripper) must come from a neighbour that also has the group before it.

    If the tree would be too large, the most probable groups are kept (*ours*). The i-th neighbour has the weight 1 / i,
    and a path changes to another neighbour with probability `cross`.

    Args:
        chunks: (k, N) tokens, most similar neighbour first.
        start: Number of committed tokens. The tree begins after them.
        space: The action space.
        nodes: Maximum number of nodes of the tree.
        depth: Maximum number of tokens on a path. None: up to the chunk's end.
        cross: Probability of a change after a group. 0: paths never change, so only whole chunks are merged.
    """
    stop = chunks.shape[1] if depth is None else min(chunks.shape[1], start + depth)
    # sets of neighbours are numbers, whose bits stand for neighbours
    everyone = (1 << len(chunks)) - 1
    levels: list[tuple[bool, list[tuple[tuple[int, ...], int]]]] = []  # is strict; each group, and who has it
    for first, end, strict in space.segments(start, stop):
        givers: dict[tuple[int, ...], int] = {}
        for i, row in enumerate(chunks[:, first:end].tolist()):
            givers[tuple(row)] = givers.get(tuple(row), 0) | 1 << i
        levels.append((strict, list(givers.items())))
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    # groups to add: (−log probability of their path, order of offers, parent node, number of groups before, tokens,
    # `last` and `whole` as in `offer`)
    waiting: list[tuple[float, int, int, int, tuple[int, ...], int, int]] = []
    order = count()

    def offer(parent: int, level: int, last: int, whole: int, cost: float) -> None:
        """Offer the groups that may come next on a path, those of the most similar neighbours first.

        Args:
            parent: Last node of the path.
            level: Number of groups on the path.
            last: The neighbours that have the last group.
            whole: The neighbours that have every group. If there are none, `last`.
            cost: −log probability of the path.
        """
        strict, givers = levels[level] if level < len(levels) else (False, [])
        pool = last if strict else everyone
        if strict:
            givers = [(group, members & last) for group, members in givers if members & last]
            givers.sort(key=lambda way: way[1] & -way[1])
        for group, members in givers:
            common = members & whole
            chance = (1 - cross) * _weight(common) / _weight(whole) + cross * _weight(members) / _weight(pool)
            if chance > 0:
                heappush(
                    waiting, (cost - math.log(chance), next(order), parent, level, group, members, common or members)
                )

    offer(ROOT, 0, everyone, everyone, 0.0)
    while waiting and len(tokens) < nodes:
        cost, _, node, level, group, last, whole = heappop(waiting)
        known = 0  # number of leading tokens of the group that are in the tree already
        while known < len(group) and (node, group[known]) in children:
            node, known = children[node, group[known]], known + 1
        if len(tokens) + len(group) - known > nodes:
            continue  # never add a group in part
        for token in group[known:]:
            children[node, token] = len(tokens)
            parents.append(node)
            node = len(tokens)
            tokens.append(token)
        if group[-1] != space.end:
            offer(node, level + 1, last, whole, cost)
    return Draft.of(tokens, parents)


@functools.lru_cache(maxsize=4096)
def _weight(members: int) -> float:
    """Return the summed weight of the neighbours in a bit set. The i-th neighbour, counted from 1, has weight 1 / i."""
    return sum([1 / (1 + i) for i in range(members.bit_length()) if members >> i & 1])
