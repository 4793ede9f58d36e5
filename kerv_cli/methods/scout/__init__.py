"""The scout: a drafter with its own vision encoder (docs/methods.md §5.1, ours)."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, DrafterPart
from kerv_cli.methods.early import EarlySettings


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


@DrafterPart(
    "scout",
    trained=ScoutSettings,
    sees=True,
    colour=0x7BC8A4,
    when=PREFILL,
    chains=True,
    drafts_whole_chunk=True,
    cost="scout",
    measured_by="scout_unverified",
)
def artifact() -> type:
    """Import and return the class that trains and loads the artifact `scout`."""
    from kerv_cli.methods.scout.drafter import ScoutDrafter

    return ScoutDrafter
