"""Spec-VLA's acceptance: token by token, strict or within one radius (docs/methods.md §2.1). Its drafter is `eagle`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.limits import MOST_BINS, number
from kerv_cli.base.registry import NoSettings, add
from kerv_cli.engine.acceptance import DistanceRule, StrictRule
from kerv_cli.engine.parts import Fixed

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context


@dataclass
class RelaxedAcceptanceSettings:
    """Spec-VLA: accepts a draft token within r bins of the target's."""

    kind: str = "relaxed"
    strict_dofs: bool = True  # ours: the action space's strict DoFs must match; the paper has one r for all


@dataclass(frozen=True)
class RelaxedRule(DistanceRule):
    """Accepts a draft token within r bins of the target's.

    Attributes:
        strict_dofs: Whether the action space's strict DoFs must match exactly.
    """

    strict_dofs: bool = True

    @classmethod
    def build(cls, settings: RelaxedAcceptanceSettings, context: Context) -> RelaxedRule:
        """Build acceptance=relaxed."""
        return cls(context.target.actions, settings.strict_dofs)

    def limits(self, r: int) -> tuple[int, ...]:
        """Return the largest accepted distance per DoF, in bins (D,): r, or 0 for strict DoFs that must match."""
        return tuple(0 if self.strict_dofs and strict else r for strict in self.space.is_strict)


def strict(settings: NoSettings, context: Context) -> StrictRule:
    """Build acceptance=strict: a draft token must equal the target's, so nothing is lost."""
    return StrictRule(context.target.actions)


@dataclass
class FixedThresholdSettings:
    """Spec-VLA: one radius."""

    kind: str = "fixed"
    r: int = number(9, 0, MOST_BINS)


def fixed(settings: FixedThresholdSettings, context: Context) -> Fixed:
    """Build threshold=fixed.

    Raises:
        UsageError: A radius above the largest distance of two tokens.
    """
    context.check_radius("r", settings.r)
    return Fixed(settings.r)


_FILE = "kerv_cli.methods.spec_vla:"
add("acceptance", "strict", _FILE + "strict", reads_threshold=False)
add("acceptance", "relaxed", _FILE + "RelaxedRule.build", RelaxedAcceptanceSettings)
add("threshold", "fixed", _FILE + "fixed", FixedThresholdSettings, batchable=True)
