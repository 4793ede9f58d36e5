"""Example: a boundary of your own: retrieval drafts while the hand is high, the drafter below."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.limits import number
from kerv_cli.base.registry import add
from kerv_cli.engine.parts import Boundary

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Choice
    from kerv_cli.methods.context import Context


@dataclass
class HeightSettings:
    """Metres above the origin."""

    kind: str = "height"
    metres: float = number(0.1, -10, 10)


class Height(Boundary):
    def __init__(self, metres: float) -> None:
        self.metres = metres

    def choose(self, path: np.ndarray) -> Choice:
        from kerv_cli.engine.chunk import Choice  # imports torch

        return Choice("retrieval" if len(path) and path[-1][2] > self.metres else "drafter")


def build(settings: HeightSettings, context: Context) -> Height:
    return Height(settings.metres)


add("boundary", "height", f"{__name__}:build", HeightSettings, chooses=True)
