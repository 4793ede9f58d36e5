"""Example: a rectifier of your own: after a rejection the whole control steps so far are executed, the rest is not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.registry import RectifierPart
from kerv_cli.engine.decisions import Rectified
from kerv_cli.engine.parts import Rectifier

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk


@RectifierPart("stop")
class Stop(Rectifier):
    def rectify(self, chunk: Chunk) -> Rectified | None:
        whole = len(chunk.tokens) // chunk.dofs
        tokens = np.array(chunk.tokens[: whole * chunk.dofs]).reshape(whole, chunk.dofs)
        return Rectified(chunk.space.values_of(tokens)) if whole else None
