"""The early drafter: drafts a whole chunk from the prompt, before the prefill (docs/methods.md §5, ours)."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, DrafterPart


@dataclass
class EarlySettings:
    """Shapes of the early drafter, a residual network from the prompt to a whole chunk (docs/methods.md §5)."""

    kind: str = "early"
    layers: int = number(2, 0, 1024)  # residual blocks
    width: int = number(384, 1, 65_536)  # hidden units
    rank: int = number(32, 1, 65_536)  # features per token, from which one head computes the logits of all bins
    samples: int = number(100_000, 1, 10**8)  # maximum number of observations whose greedy decodes it is trained on


@DrafterPart(
    "early",
    trained=EarlySettings,
    colour=0xD4A6C8,
    when=PREFILL,
    chains=True,
    drafts_whole_chunk=True,
    cost="early",
    measured_by="early_unverified",
    any_code=True,
)
def early() -> type:
    from kerv_cli.methods.early.drafter import EarlyDrafter

    return EarlyDrafter
