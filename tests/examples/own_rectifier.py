"""Example: a rectifier of your own: after a rejection the whole control steps so far are executed, the rest is not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.registry import NoSettings, add

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.methods.context import Context


class Stop:
    """The `Rectifier` protocol of `kerv_cli/engine/parts.py`."""

    uses_target_token = True

    def reset(self) -> None:
        """Nothing is kept between decodes."""

    def next_decode(self) -> None:
        """Nothing is counted."""

    def close(self, chunk: Chunk) -> bool:
        whole = len(chunk.tokens) // chunk.dofs
        if whole:
            tokens = np.array(chunk.tokens[: whole * chunk.dofs]).reshape(whole, chunk.dofs)
            chunk.close(chunk.space.values_of(tokens), with_target_token=True)
        return whole > 0


def build(settings: NoSettings, context: Context) -> Stop:
    return Stop()


add("rectifier", "stop", f"{__name__}:build")
