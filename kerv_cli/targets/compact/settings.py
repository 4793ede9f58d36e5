"""Settings of the compact target."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting


@dataclass
class TargetSettings:
    """Shapes of the target (docs/methods.md §0). `conf/target/*.yaml` are the sizes."""

    size: str = setting("small", "name of these shapes")
    observation: str = choice("vision", "vision", "state", help="state: privileged, the places' positions are given")
    width: int = number(192, 2, 65_536, help="of the hidden states")
    layers: int = number(8, 1, 1024, help="decoder layers")
    heads: int = number(6, 1, 1024, help="attention heads")
    feed_forward: int = number(512, 1, 262_144, help="hidden units of a layer's feed-forward part")
    chunk: int = number(4, 1, 1024, help="H, control steps per decode")
    grid: int = number(4, 1, 512, help="vision tokens per side")
    keypoints: int = number(32, 1, 4096, help="spatial soft-argmax points of the vision encoder")
    channels: int = number(24, 1, 4096, help="width of the vision encoder's first stage")
    norm: str = choice("group", "group", "instance", help="of the vision encoder; instance: light changes it least")
    scene_tokens: int = number(4, 1, 1024, help="tokens with the places' positions, estimated or given")
    instruction_tokens: int = number(10, 1, 1024, help="longest instruction")
    image_size: int = number(96, 8, 4096, help="pixels of a view, square")
    parallel: bool = setting(False, "decode all tokens of a chunk at once (docs/methods.md §6)")

    def check_together(self, prefix: str) -> None:
        """Raises UsageError for a width that the heads do not divide, or an image that the grid does not divide."""
        if self.width % (2 * self.heads):
            raise UsageError(f"{prefix}width={self.width} must be a multiple of 2 x {prefix}heads={self.heads}")
        if self.observation == "vision" and self.image_size % (8 * self.grid):
            raise UsageError(f"{prefix}image_size={self.image_size} must be a multiple of 8 x {prefix}grid={self.grid}")
