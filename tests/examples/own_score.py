"""Example: a score of your own for a gate, larger = safer: how small the draft's largest action is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.registry import NoSettings, add

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context
    from kerv_cli.methods.risk.scores import Draft


class Calm:
    """The `Score` protocol of `kerv_cli/methods/risk/scores.py`."""

    def of(self, draft: Draft) -> float:
        return -float(np.abs(draft.chunk.space.values_of(np.array(draft.tokens))).max())


def build(settings: NoSettings, context: Context) -> Calm:
    return Calm()


add("score", "calm", f"{__name__}:build")
