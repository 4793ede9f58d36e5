"""Acceptance token by token: strict, and Spec-VLA's within its one radius (docs/methods.md §2.1)."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.registry import NoSettings
from kerv_cli.engine.acceptance import Strict
from kerv_cli.engine.parts import Fixed
from kerv_cli.methods.context import Context
from kerv_cli.methods.spec_vla import FixedThresholdSettings, RelaxedAcceptanceSettings


@dataclass(frozen=True)
class Relaxed(Strict):
    """A draft token within r bins of the target's is kept. strict_dofs: the space's strict DoFs must match."""

    strict_dofs: bool = True

    @classmethod
    def build(cls, settings: RelaxedAcceptanceSettings, context: Context) -> Relaxed:
        """acceptance=relaxed."""
        return cls(context.target.actions, settings.strict_dofs)

    def limits(self, r: int) -> tuple[int, ...]:
        """Largest accepted distance per DoF, bins (D,): r, for strict DoFs 0 where those must match."""
        return tuple(0 if self.strict_dofs and strict else r for strict in self.space.is_strict)


def strict(settings: NoSettings, context: Context) -> Strict:
    """acceptance=strict."""
    return Strict(context.target.actions)


def fixed(settings: FixedThresholdSettings, context: Context) -> Fixed:
    """threshold=fixed.

    Raises:
        UsageError: a radius above the largest distance of two tokens.
    """
    context.check_radius("r", settings.r)
    return Fixed(settings.r)
