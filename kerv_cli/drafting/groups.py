"""Kinematic groups: the DoFs of a control step's action that are drafted and judged together (METHODS §2.1)."""

from __future__ import annotations

from collections.abc import Iterator

Groups = tuple[tuple[int, ...], ...]
"""DoFs of one control step, group by group, in the tokens' order; the last group is the gripper."""

_KNOWN: dict[int, Groups] = {
    4: ((0, 1, 2), (3,)),  # Meta-World: position, gripper
    7: ((0, 1, 2), (3, 4, 5), (6,)),  # OpenVLA: position, rotation, gripper
}


def kinematic_groups(dofs: int) -> Groups:
    """The groups of an action with `dofs` DoFs.

    Raises:
        ValueError: an action of another size: its groups have to be given.
    """
    if dofs not in _KNOWN:
        raise ValueError(f"no kinematic groups for {dofs} DoFs: give them")
    return _KNOWN[dofs]


def bounds(groups: Groups) -> list[tuple[int, int]]:
    """Per DoF: the first DoF of its group, and one past the last.

    Raises:
        ValueError: groups that leave a DoF out, repeat one or are not in order.
    """
    flat = [dof for group in groups for dof in group]
    if flat != list(range(len(flat))) or not all(groups):
        raise ValueError(f"groups {groups} do not cover the DoFs in order")
    return [(group[0], group[-1] + 1) for group in groups for _ in group]


def segments(start: int, stop: int, groups: Groups) -> Iterator[tuple[int, int, bool]]:
    """Chunk indices [first, last) of every group between `start` and `stop`, and whether it is a gripper's. A group
    that lies partly outside is cut."""
    ends = bounds(groups)
    while start < stop:
        step, dof = divmod(start, len(ends))
        last = min(stop, step * len(ends) + ends[dof][1])
        yield start, last, ends[dof][1] == len(ends)
        start = last
