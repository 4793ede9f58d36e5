"""Acceptance token by token, strict or within Spec-VLA's one radius (docs/methods.md §2.1). Settings, registration."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_BINS, number
from kerv_cli.base.registry import add

_RULES = "kerv_cli.methods.spec_vla.rules:"

add("acceptance", "strict", _RULES + "strict")  # a draft token must equal the target's: lossless


@dataclass
class RelaxedAcceptanceSettings:
    """Spec-VLA: a draft token within r bins of the target's is kept."""

    kind: str = "relaxed"
    strict_dofs: bool = True  # ours: the action space's strict DoFs must match; the paper has one r for all


add("acceptance", "relaxed", _RULES + "Relaxed.build", RelaxedAcceptanceSettings)


# that r lies below the number of tokens is checked when a threshold is built
@dataclass
class FixedThresholdSettings:
    """Spec-VLA: one radius."""

    kind: str = "fixed"
    r: int = number(9, 0, MOST_BINS)


add("threshold", "fixed", _RULES + "fixed", FixedThresholdSettings)
