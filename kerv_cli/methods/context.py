"""The context in which a method's part is built."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Context:
    """What a part of a method (a proposer, skip rule, threshold, …) is built from, besides its own settings.

    Attributes:
        target: A `Target`. Some parts need a `ReadableTarget` (`engine/protocol.py`).
        artifact: Function that returns the loaded artifact of a kind, such as `drafter`.
        task: Full name of the task. Empty if unknown.
        built: The method's parts that are built already, by kind such as `proposer`.
        chunk: Number of control steps per chunk. If 0, as many as the target was trained for.
    """

    target: Any
    artifact: Callable[[str], Any]
    task: str = ""
    built: dict[str, Any] = field(default_factory=dict)
    chunk: int = 0

    @property
    def calibration(self) -> Any:
        return self.artifact("calibration")
