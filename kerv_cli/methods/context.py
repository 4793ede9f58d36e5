"""What a part is made from. The registry's `build` of a part of a method takes (settings, context) and returns the
part, or None for the absence of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from kerv_cli.base.errors import UsageError


@dataclass(frozen=True)
class Context:
    """The surroundings of a part. artifact: kind -> the loaded artifact. task: full name, or empty. built: the method's
    parts so far, by kind. method: the settings of all its parts, by kind. chunk: H, 0: the target's."""

    target: Any  # a Target; some parts want a ReadableTarget
    artifact: Callable[[str], Any]
    task: str = ""
    built: dict[str, Any] = field(default_factory=dict)
    method: Mapping[str, Any] = field(default_factory=dict)
    chunk: int = 0

    @property
    def calibration(self) -> Any:
        """The target's `Calibration`; not by its type, which the parts that it is read for would import."""
        return self.artifact("calibration")

    def check_radius(self, name: str, r: int) -> None:
        """Raises UsageError for a radius above the largest distance of two tokens. name: of the threshold's setting."""
        most = self.target.actions.tokens - 1
        if r > most:
            raise UsageError(f"threshold.{name}={r}: bins from 0 to {most}")
