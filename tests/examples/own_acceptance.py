"""Example: an acceptance rule of your own: the radius holds for the hand's position, all else must match."""

from __future__ import annotations

from kerv_cli.base.registry import AcceptancePart
from kerv_cli.engine.acceptance import DistanceRule


@AcceptancePart("position")
class PositionOnly(DistanceRule):
    """Accepts the longest path within its limits, as its base does; another rule overrides `judge`."""

    def limits(self, r: int) -> tuple[int, ...]:
        free = range(self.space.dofs)[self.space.dofs_of("position")]
        return tuple(r if dof in free else 0 for dof in range(self.space.dofs))
