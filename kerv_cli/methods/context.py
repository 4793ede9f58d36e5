"""What parts are made from: `build` of a method's part takes (settings, context) and returns the part, or None."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from kerv_cli.base.errors import UsageError


@dataclass(frozen=True)
class Context:
    """The surroundings of a part.

    Attributes:
        target: A Target. Some parts want a ReadableTarget.
        artifact: Returns the loaded artifact of a kind.
        task: Full name, or empty.
        built: The parts that are built already, by kind.
        method: Settings of all parts, by kind.
        chunk: H; 0 for the target's.
    """

    target: Any  # a Target; some parts want a ReadableTarget
    artifact: Callable[[str], Any]
    task: str = ""
    built: dict[str, Any] = field(default_factory=dict)
    method: Mapping[str, Any] = field(default_factory=dict)
    chunk: int = 0

    @property
    def calibration(self) -> Any:
        """The target's `Calibration`. Its type would be a circular import."""
        return self.artifact("calibration")

    def check_radius(self, name: str, r: int) -> None:
        """Refuse a radius above the largest distance of two tokens.

        Args:
            name: Of the threshold's setting.
            r: The radius in bins.

        Raises:
            UsageError: It is too large.
        """
        most = self.target.actions.tokens - 1
        if r > most:
            raise UsageError(f"threshold.{name}={r}: bins from 0 to {most}")
