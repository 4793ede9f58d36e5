"""The scout: a drafter with its own vision encoder (docs/methods.md §5.1, ours)."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, add_drafter
from kerv_cli.methods.early import EarlySettings


@dataclass
class ScoutSettings(EarlySettings):
    """Shapes of a scout: its stem, then the network of the early drafter (§5.1)."""

    kind: str = "scout"
    channels: int = number(8, 1, 4096, help="of the stem's first stage")
    keypoints: int = number(16, 1, 4096, help="image points of a view")
    grid: int = number(4, 1, 512, help="rows and columns of cells of a view")
    cell_width: int = number(48, 1, 4096, help="numbers of a cell")
    cell_features: int = number(8, 1, 4096, help="of these, those that the network reads of each cell, beside the mean")
    word_width: int = number(32, 1, 4096, help="numbers of a word")


add_drafter(
    "scout",
    "kerv_cli.methods.scout.drafter:ScoutDrafter",
    ScoutSettings,
    sees=True,
    colour=0x7BC8A4,
    when=PREFILL,
    chains=True,
    drafts_whole_chunk=True,
    batchable=True,
)
