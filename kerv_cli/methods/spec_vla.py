"""Spec-VLA's acceptance, token by token: equality, or a distance of at most r bins (docs/methods.md §2.1).

Spec-VLA's drafter is in the folder `eagle`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kerv_cli.base.limits import MOST_BINS, number
from kerv_cli.base.registry import AcceptancePart, ThresholdPart
from kerv_cli.engine.acceptance import DistanceRule, StrictRule
from kerv_cli.engine.parts import Fixed

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context


AcceptancePart("strict", reads_threshold=False, any_code=True)(StrictRule)


@dataclass
class RelaxedAcceptanceSettings:
    """Spec-VLA: accept a draft token if it is at most r bins from the target's token."""

    kind: str = "relaxed"
    strict_dofs: bool = True  # true: strict DoFs, such as the gripper, must be equal (ours); false: r for all (paper)


@AcceptancePart("relaxed", RelaxedAcceptanceSettings)
@dataclass(frozen=True)
class RelaxedRule(DistanceRule):
    """Accepts a draft token at most r bins from the target's token. With `strict_dofs`, strict DoFs must be equal."""

    strict_dofs: bool = True

    @classmethod
    def build(cls, settings: Any, context: Context) -> RelaxedRule:
        return cls(context.target.actions, settings.strict_dofs)

    def limits(self, r: int) -> tuple[int, ...]:
        return self.same_limits(r, self.strict_dofs)


@dataclass
class FixedThresholdSettings:
    """Spec-VLA: the same acceptance radius in every decode."""

    kind: str = "fixed"
    r: int = number(9, 0, MOST_BINS)  # largest accepted distance to the target's token, bins


ThresholdPart("fixed", FixedThresholdSettings, radius="r", any_code=True)(Fixed)
