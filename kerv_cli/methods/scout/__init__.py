"""The scout: a drafter with eyes of its own (docs/methods.md §5.2, ours). Settings and registration."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, add
from kerv_cli.base.settings import DrafterSettings


@dataclass
class ScoutSettings(DrafterSettings):
    """Shapes of a scout: its stem, then the early drafter's network."""

    kind: str = "scout"
    layers: int = number(2, 0, 1024)
    width: int = number(384, 1, 65_536)
    rank: int = number(32, 1, 65_536)
    history: int = number(0, 0, 1024)
    channels: int = number(8, 1, 4096)  # of the stem's first stage
    keypoints: int = number(16, 1, 4096)  # image points
    grid: int = number(4, 1, 512)  # cells per side
    cell_width: int = number(48, 1, 4096)
    cell_features: int = number(8, 1, 4096)  # of each cell that the network reads; of all cells it reads the mean
    word_width: int = number(32, 1, 4096)
