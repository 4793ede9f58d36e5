"""Drafters of whole chunks, before the target's trunk runs: early drafter, scout (docs/methods.md §5, §5.1, ours)."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, DrafterPart

WholeChunkPart = functools.partial(DrafterPart, when=PREFILL, chains=True, drafts_whole_chunk=True)


@dataclass
class EarlySettings:
    """Shapes of the early drafter, a residual network from the prompt to a whole chunk (docs/methods.md §5)."""

    kind: str = "early"
    layers: int = number(2, 0, 1024)  # residual blocks
    width: int = number(384, 1, 65_536)  # hidden units
    rank: int = number(32, 1, 65_536)  # features per token, from which one head computes the logits of all bins
    samples: int = number(100_000, 1, 10**8)  # maximum number of observations whose greedy decodes it is trained on


@WholeChunkPart(
    "early", trained=EarlySettings, colour=0xD4A6C8, cost="early", measured_by="early_unverified", any_code=True
)
def early() -> type:
    """Import and return the class that trains and loads the artifact `early`, the early drafter."""
    from kerv_cli.methods.early.drafter import EarlyDrafter

    return EarlyDrafter


@dataclass
class ScoutSettings(EarlySettings):
    """Shapes of a scout: a vision encoder, then the network of the early drafter (docs/methods.md §5.1)."""

    kind: str = "scout"
    channels: int = number(8, 1, 4096, help="channels of the vision encoder's first stage")
    keypoints: int = number(16, 1, 4096, help="image points per camera view")
    grid: int = number(4, 1, 512, help="each camera view is cut into grid × grid cells")
    cell_width: int = number(48, 1, 4096, help="features per cell; their mean over all cells is read")
    cell_features: int = number(8, 1, 4096, help="features read from each single cell")
    word_width: int = number(32, 1, 4096, help="width of the word embeddings")


@WholeChunkPart(
    "scout", trained=ScoutSettings, sees=True, colour=0x7BC8A4, cost="scout", measured_by="scout_unverified"
)
def scout() -> type:
    """Import and return the class that trains and loads the artifact `scout`."""
    from kerv_cli.methods.early.drafter import ScoutDrafter

    return ScoutDrafter
