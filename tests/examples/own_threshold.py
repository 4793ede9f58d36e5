"""Example: a threshold of your own: the radius grows by `step` bins with every decode of an episode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.limits import number
from kerv_cli.base.registry import ThresholdPart
from kerv_cli.engine.parts import Threshold

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context


@dataclass
class GrowingSettings:
    """Bins."""

    kind: str = "growing"
    step: int = number(1, 0, 100)
    most: int = number(9, 0, 254)


@ThresholdPart("growing", GrowingSettings, radius="most")
class Growing(Threshold):
    def __init__(self, settings: GrowingSettings, context: Context) -> None:
        self.settings, self.decodes = settings, 0

    def reset(self) -> None:
        self.decodes = 0

    def radius(self) -> int:
        return min(self.settings.most, self.settings.step * self.decodes)

    def update(self, variability: float | None) -> None:
        self.decodes += 1
