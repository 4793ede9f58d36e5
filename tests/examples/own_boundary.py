"""Example: a boundary of your own: retrieval drafts while the hand is high, the drafter below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kerv_cli.base.limits import number
from kerv_cli.base.registry import BoundaryPart
from kerv_cli.engine.decisions import Choice
from kerv_cli.engine.parts import Boundary


@dataclass
class HeightSettings:
    """Metres above the origin."""

    kind: str = "height"
    metres: float = number(0.1, -10, 10)


@BoundaryPart("height", HeightSettings, chooses=True)
class Height(Boundary):
    def choose(self, path: np.ndarray) -> Choice:
        return Choice("retrieval" if len(path) and path[-1][2] > self.settings.metres else "drafter")
