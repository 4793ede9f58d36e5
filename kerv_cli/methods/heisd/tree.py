"""Merge stored chunks into one draft tree of kinematic groups (docs/methods.md §4.2)."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from heapq import heappop, heappush
from itertools import count

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.tree import ROOT

CROSS = 0.1  # assumed probability that a path of retrieved groups changes to another neighbour after a group


def neighbour_tree(
    chunks: np.ndarray,
    start: int,
    space: ActionSpace,
    nodes: int = 50,
    depth: int | None = None,
    cross: float = CROSS,
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
    continuations = _Continuations(chunks.tolist(), list(space.segments(start, stop)), cross)
    tokens: list[int] = []
    parents: list[int] = []
    children: dict[tuple[int, int], int] = {}
    # groups to add: (−log probability of their path, order of offers, parent node, number of groups before, tokens,
    # `last` and `whole` as in _Continuations)
    waiting: list[tuple[float, int, int, int, tuple[int, ...], int, int]] = []
    order = count()

    def offer(parent: int, level: int, last: int, whole: int, cost: float) -> None:
        for surprise, group, members, common in continuations.on(level, last, whole):
            heappush(waiting, (cost + surprise, next(order), parent, level, group, members, common))

    offer(ROOT, 0, continuations.everyone, continuations.everyone, 0.0)
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


class _Continuations:
    """Lists the kinematic groups of tokens that may come next on a path of the tree, with their probabilities.

    Retrieval returns stored chunks, the neighbours. Their tokens are cut into kinematic groups. A caller describes the
    groups chosen so far by two sets of neighbours, `last` and `whole`, whose bits stand for neighbours. `last` has the
    neighbours whose chunk contains the last chosen group. `whole` has those whose chunk contains every chosen group. If
    there are none, `whole` is set to `last`.

    Args:
        rows: Tokens of each neighbour's chunk, most similar neighbour first.
        cuts: For each group: index of its first token, index after its last token, whether its DoFs are strict.
        cross: Probability that a path changes to another neighbour after a group.
    """

    def __init__(self, rows: list[list[int]], cuts: list[tuple[int, int, bool]], cross: float) -> None:
        self.everyone = (1 << len(rows)) - 1
        self.cross = cross
        self.levels: list[tuple[bool, list[tuple[tuple[int, ...], int]]]] = []
        for first, last, strict in cuts:
            givers: dict[tuple[int, ...], int] = {}
            for i, row in enumerate(rows):
                group = tuple(row[first:last])
                givers[group] = givers.get(group, 0) | 1 << i
            self.levels.append((strict, list(givers.items())))

    def on(self, level: int, last: int, whole: int) -> Iterator[tuple[float, tuple[int, ...], int, int]]:
        """List the groups that may be chosen next, those of the most similar neighbours first.

        Args:
            level: Number of groups chosen so far.
            last: Bit set of the neighbours that have the last chosen group.
            whole: Bit set of the neighbours that have every chosen group.

        Yields:
            (−log probability of the group, its tokens, and `last` and `whole` if this group is chosen).
        """
        if level == len(self.levels):
            return
        strict, givers = self.levels[level]
        pool = self.everyone
        if strict:
            pool = last
            givers = [(group, members & last) for group, members in givers if members & last]
            givers.sort(key=lambda way: way[1] & -way[1])
        cross, of_whole, of_pool = self.cross, _weight(whole), _weight(pool)
        for group, members in givers:
            common = members & whole
            probability = (1 - cross) * _weight(common) / of_whole + cross * _weight(members) / of_pool
            if probability > 0:
                yield -math.log(probability), group, members, common or members
