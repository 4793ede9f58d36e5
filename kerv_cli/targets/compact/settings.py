"""Settings of the compact target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting


@dataclass
class TargetSettings:
    """Shapes of the compact target (docs/methods.md §0.1). Each file in `conf/target` is a ready-made set of shapes."""

    size: str = setting("small", "name of these shapes")
    observation: str = choice("vision", "vision", "state", help="read images, or the simulator's state")
    width: int = number(192, 2, 65_536, help="width E of the embeddings and hidden states")
    layers: int = number(8, 1, 1024, help="decoder layers")
    heads: int = number(6, 1, 1024, help="attention heads")
    feed_forward: int = number(512, 1, 262_144, help="hidden units of a layer's feed-forward part")
    chunk: int = number(4, 1, 1024, help="H, control steps per decode")
    code: str = choice("bins", "bins", "fast", help="tokens: a bin per number, or a FAST code of the whole chunk")
    grid: int = number(4, 1, 512, help="vision tokens per side")
    keypoints: int = number(32, 1, 4096, help="points that the vision encoder finds in an image (spatial soft-argmax)")
    channels: int = number(24, 1, 4096, help="width of the vision encoder's first stage")
    norm: str = choice("group", "group", "instance", help="vision encoder's norm; instance: least sensitive to light")
    scene_tokens: int = number(4, 1, 1024, help="prompt tokens that hold the positions of object and goal")
    instruction_tokens: int = number(10, 1, 1024, help="longest instruction in words")
    image_size: int = number(96, 8, 4096, help="pixels per side of a camera view")
    parallel: bool = setting(False, "decode all tokens of a chunk at once (docs/methods.md §6)")

    def check_together(self, prefix: str) -> None:
        """Check settings that depend on each other.

        Args:
            prefix: Start of the settings' names in error messages, such as `target.`.

        Raises:
            UsageError: The width is no multiple of twice the heads, or the image no multiple of 8 times the grid. Or a
                parallel target has chunks of different lengths.
        """
        if self.parallel and self.code != "bins":
            raise UsageError(f"{prefix}parallel=true: chunks of {prefix}code={self.code} differ in length; use bins")
        if self.width % (2 * self.heads):
            raise UsageError(f"{prefix}width={self.width} must be a multiple of 2 x {prefix}heads={self.heads}")
        if self.observation == "vision" and self.image_size % (8 * self.grid):
            raise UsageError(f"{prefix}image_size={self.image_size} must be a multiple of 8 x {prefix}grid={self.grid}")


def prompt_tokens(target: Mapping[str, Any]) -> int | None:
    """Return P, the number of prompt tokens of a compact or grown target. None if the target is of another family.

    Args:
        target: Content of the target's `target.json`.
    """
    own = target.get("settings", {})
    if not {"grid", "instruction_tokens", "scene_tokens"} <= set(own):
        return None
    views = len(target["cameras"]) if own.get("observation") != "state" else 0
    prompt: int = own["grid"] ** 2 * views + own["instruction_tokens"] + own["scene_tokens"] + 1
    return own.get("grown", {}).get("prompt") or prompt
