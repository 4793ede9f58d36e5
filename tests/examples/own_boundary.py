"""Example: a boundary of your own: retrieval drafts while the hand is high, the drafter below."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.limits import number
from kerv_cli.base.registry import add

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Choice
    from kerv_cli.methods.context import Context


@dataclass
class HeightSettings:
    """Metres above the origin."""

    kind: str = "height"
    metres: float = number(0.1, -10, 10)


class Height:
    """The `Boundary` protocol of `kerv_cli/engine/parts.py`."""

    def __init__(self, metres: float) -> None:
        self.metres = metres

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        from kerv_cli.engine.chunk import Choice  # imports torch

        return Choice("retrieval" if len(path) and path[-1][2] > self.metres else "drafter")

    def numbers(self, task: str, seed: int) -> np.random.Generator:
        return np.random.default_rng(seed)


def build(settings: HeightSettings, context: Context) -> Height:
    return Height(settings.metres)


add("boundary", "height", f"{__name__}:build", HeightSettings, chooses=True)
