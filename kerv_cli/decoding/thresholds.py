"""How far a draft may be from the verdict (METHODS §3.2)."""

from __future__ import annotations

from typing import Protocol

from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.settings import ThresholdSettings
from kerv_cli.vla.action_tokens import VOCABULARY


class Threshold(Protocol):
    def reset(self) -> None:
        """A new episode begins."""

    def radius(self) -> int:
        """r of the next decode, in bins."""

    def update(self, variability: float | None) -> None:
        """A decode ended; its kinematic variability K in normalised action units, None where nothing was compared."""


class Fixed:
    def __init__(self, r: int) -> None:
        if not 0 <= r < VOCABULARY:
            raise UsageError(f"threshold.r={r}: bins from 0 to {VOCABULARY - 1}")
        self.r = r

    def reset(self) -> None:
        pass

    def radius(self) -> int:
        return self.r

    def update(self, variability: float | None) -> None:
        pass


def build_threshold(settings: ThresholdSettings) -> Threshold:
    if settings.kind == "fixed":
        return Fixed(settings.r)
    raise UnknownName("threshold.kind", settings.kind, ["fixed"])
